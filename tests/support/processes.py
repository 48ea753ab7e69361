"""Programs that a test begins, and that do not outlive it."""

from contextlib import contextmanager


@contextmanager
def ended_at_last(process):
    """A `subprocess.Popen` as long as the context lasts: where the test fails before it ends, nobody waits for it."""
    with process:
        try:
            yield process
        finally:
            process.kill()  # nothing where it has ended
