"""What is said of an object's dimensions, by frames that were compared with several views."""

from types import SimpleNamespace

import numpy as np

from morph_dslam.diagnostics.dimensions import StretchEvidence, keeping_the_mean
from morph_dslam.diagnostics.statements import FrameStatements
from morph_dslam.tracking.result import DIMENSIONS_OFF, UNCHECKED

SHEET = np.array([True, True, False])


def view(number, longer=0.0, deviation=None):
    """A view whose frames tell that the model is so much longer along x than along y, or nothing."""
    told = StretchEvidence.none(SHEET)
    if deviation is not None:
        off = keeping_the_mean(SHEET) @ keeping_the_mean(SHEET).T / (deviation**2 / 2.0)
        told = StretchEvidence(SHEET, off, off @ [longer, 0.0, 0.0])
    return SimpleNamespace(number=number, systematic=SimpleNamespace(stretch=told))


def statements():
    return FrameStatements(np.zeros(0, dtype=np.int64))


def said_of(statement, of_view, is_free=True):
    elsewhere = [told for number, told in statement._stretch.items() if number != of_view.number]
    return statement._on_dimensions(of_view, elsewhere, is_free)


def test_what_one_view_has_shown_is_said_while_another_is_followed():
    statement = statements()
    assert said_of(statement, view(0)) == ("", f"; {UNCHECKED}")
    off = "by about 4 % along x against y"
    assert said_of(statement, view(0, 0.04, 0.004)) == (off, f"; {DIMENSIONS_OFF}: {off}")
    assert said_of(statement, view(1)) == (off, f"; {DIMENSIONS_OFF}: {off}")
    # The first view tells as much again: what it told before is in that already.
    assert said_of(statement, view(0, 0.04, 0.011)) == ("", f"; {UNCHECKED}")


def test_what_one_view_has_excluded_stays_excluded():
    statement = statements()
    assert said_of(statement, view(0, 0.001, 0.003)) == ("", "")
    assert said_of(statement, view(1)) == ("", "")


def test_two_views_show_together_what_neither_does():
    statement = statements()
    assert said_of(statement, view(0, 0.03, 0.01))[0] == ""
    assert said_of(statement, view(1, 0.03, 0.01))[0] == "by about 3 % along x against y"


def test_an_object_that_was_found_in_a_map_is_not_doubted_before_it_shows_anything():
    statement = statements()
    assert said_of(statement, view(0), is_free=False) == ("", "")
    assert said_of(statement, view(0, 0.04, 0.004), is_free=False)[0] == "by about 4 % along x against y"


def test_nothing_is_said_where_the_reference_is_not_known():
    unknown = SimpleNamespace(number=0, systematic=SimpleNamespace(stretch=None))
    assert said_of(statements(), unknown) == ("", "")
