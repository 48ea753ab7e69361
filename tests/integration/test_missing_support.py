"""A study whose supports let the body move as a whole."""

import pytest

import morph_dslam as md


def moved(supports):
    """The certificate's warnings of a small block pulled at one end by up to 3 mm."""
    study = md.make_study(
        {
            "name": "block",
            "mesh": {"generator": "block", "size": ["9 mm", "9 mm", "27 mm"], "divisions": [1, 1, 3], "cells": "hex8"},
            "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.3}},
            "supports": [
                {"kind": "displacement", "on": "z_max", "x": "0 mm", "y": "0 mm", "z": "way"}, *supports,
            ],
            "parameters": {"way": {"range": ["0 mm", "3 mm"]}},
            "sampling": {"scheme": "even", "training": 8, "held_out": 4, "refined": 0},
            "solver": {"workers": 1},
        }
    )  # fmt: skip
    return md.build(study).certificate.get("warnings", [])


@pytest.mark.parametrize(("supports", "count"), [([], 1), ([{"kind": "fixed", "on": "z_min"}], 0)])
def test_a_body_that_only_moves_is_said_to(supports, count):
    found = moved(supports)
    assert len(found) == count
    assert all("is a support missing?" in warning for warning in found)
