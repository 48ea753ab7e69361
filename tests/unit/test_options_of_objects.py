"""Which options of the command line reach which object of a run."""

from pathlib import Path

import pytest

from morph_dslam.cli.app import new_parser
from morph_dslam.cli.track import run_options
from morph_dslam.errors import TrackingError
from morph_dslam.tracking.combinations import check_options

COMMAND = "track film --model a.morph --camera c.yaml --landmarks a.csv -o run --also lid lid.morph"


def asked(more):
    arguments = new_parser().parse_args(f"{COMMAND} {more}".split())
    return run_options(arguments, frames=arguments.frames)


def test_what_holds_for_every_object_reaches_one_that_starts_by_landmarks():
    run = asked("lid.csv --still --outline --snap --at-rest --start constant-velocity --one-view")
    for part in run.objects:
        assert (part.snap, part.at_rest) == (True, True)
        assert (part.tracker.pose, part.tracker.use_outline) == ("still", True)
        assert (part.tracker.start, part.tracker.new_views) == ("constant-velocity", False)
    check_options(run)


def test_what_is_of_one_model_stays_with_the_first_object():
    more = "--per-sequence k --modulus-std 5 --known k.csv --time-zero 3 --inner t.h5 --point tip=1,2,3 --no-texture"
    first, lid = asked(f"lid.csv {more}").objects
    assert (first.known, first.time_zero, first.inner) == (Path("k.csv"), 3.0, (Path("t.h5"),))
    assert (lid.known, lid.time_zero, lid.inner, lid.points) == (None, None, (), ())
    assert (first.tracker.per_sequence, lid.tracker.per_sequence) == (("k",), ())
    assert (first.tracker.modulus_std, lid.tracker.modulus_std) == (pytest.approx(0.05), 0.0)
    assert (first.tracker.use_texture, first.tracker.use_outline) == (False, True)
    assert (lid.tracker.use_texture, lid.tracker.use_outline) == (True, False)


def test_of_an_object_in_a_map_nothing_is_asked_that_only_landmarks_have():
    run = asked("lid.json --snap --at-rest --outline --pose free")
    assert [(part.snap, part.at_rest, part.tracker.use_outline) for part in run.objects] == [
        (True, True, True),
        (False, False, True),
    ]
    assert run.objects[1].tracker.pose == "free"
    check_options(run)
    with pytest.raises(TrackingError, match="stands still in it already"):
        check_options(asked("lid.json --still"))
