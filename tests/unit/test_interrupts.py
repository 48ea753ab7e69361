"""Interrupts that wait, each a real signal to this process."""

import signal
import threading

import pytest

from morph_dslam.cli.interruption import interrupt_behind
from morph_dslam.interrupts import WaitingInterrupts
from morph_dslam.sources.live import LiveStream
from morph_dslam.tracking.live import LivePipeline

pytestmark = pytest.mark.usefixtures("interruptible")


def interrupt():
    signal.raise_signal(signal.SIGINT)


def test_an_interrupt_waits_for_the_end_and_says_so_once(capsys):
    done = []

    def interrupted():
        with WaitingInterrupts("writing ..."):
            for _ in range(3):
                interrupt()
                done.append("whole")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(done) == 3
    assert capsys.readouterr().err.splitlines() == ["", "writing ..."]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_one_that_comes_while_another_ends_the_work_is_not_raised_again():
    done = []

    def interrupted():
        try:
            raise KeyboardInterrupt("the first one")
        finally:
            with WaitingInterrupts():
                interrupt()
                done.append("whole")
            done.append("behind it")

    with pytest.raises(KeyboardInterrupt, match="the first one"):
        interrupted()
    assert done == ["whole", "behind it"]


def test_an_error_of_the_work_counts_for_more_than_an_interrupt_that_waits():
    def failing():
        with WaitingInterrupts():
            interrupt()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        failing()


def test_a_second_one_is_raised_at_once_where_only_the_first_waits():
    done = []

    def interrupted():
        with WaitingInterrupts(only_first=True):
            interrupt()
            done.append("one waits")
            interrupt()
            done.append("two wait")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert done == ["one waits"]


def test_what_waits_is_raised_where_it_may_be():
    with WaitingInterrupts(only_first=True) as interrupts:
        interrupts.raise_waiting()
        interrupt()
        with pytest.raises(KeyboardInterrupt):
            interrupts.raise_waiting()
        interrupts.raise_waiting()


def test_interrupts_that_are_ignored_stay_so():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with WaitingInterrupts():
        interrupt()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_an_interrupt_behind_another_error_is_found():
    interrupt, lost = KeyboardInterrupt("here"), SystemError("a result with an exception set")
    lost.__cause__ = interrupt
    assert interrupt_behind(interrupt) is interrupt
    assert interrupt_behind(lost) is interrupt
    assert interrupt_behind(SystemError()) is None


class OneItem(LiveStream):
    """A stream of one item, read by those who take it."""

    def __iter__(self):
        yield 1

    def close(self):
        self.closing = True


def test_no_step_of_a_live_run_goes_on_behind_a_second_interrupt():
    """What is handed out while results are written would be in some of the files only."""
    seen = threading.Event()
    done = []

    def step(_):
        main = threading.main_thread().ident
        assert main is not None
        signal.pthread_kill(main, signal.SIGINT)
        while not pipeline_stream.closing:  # until the first one ends the run
            seen.wait(0.01)
        signal.pthread_kill(main, signal.SIGINT)
        seen.wait(0.3)
        done.append("whole")

    pipeline_stream = OneItem("one item", 30.0)
    with pytest.raises(KeyboardInterrupt):
        LivePipeline(pipeline_stream, [step]).run()
    assert done == ["whole"]
