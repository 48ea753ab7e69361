"""Options of the tracker and of runs: values that mean nothing are refused, and paths may be text."""

from dataclasses import replace
from pathlib import Path

import pytest

import morph_dslam as md
from morph_dslam.errors import TrackingError
from morph_dslam.extend.registration import InitializerFiles
from morph_dslam.extend.tracking import EstimationOptions, LoadOptions


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("pose", "stil", "'still'"),
        ("start", "foo", "'constant-velocity'"),
        ("n_points", -5, "a whole number from 1 up"),
        ("n_points", 300.0, "a whole number"),
        ("max_views", 0, "from 1 up"),
        ("least_share", 5.0, "from 0 to 1"),
        ("modulus_std", 5, "from 0 to 1"),
        ("modulus_std", -0.1, "from 0 to 1"),
        ("depth_sigma", 0.0, "above 0"),
        ("depth_sigma", float("nan"), "above 0"),
        ("use_depth", "no", "True or False"),
        ("per_sequence", "young", "a tuple"),
        ("random_walk", (("arch",),), "a tuple"),
        ("inlier_px", (2.0, -1.0), "from 0 up"),
        ("estimation", 3.0, "EstimationOptions"),
    ],
)
def test_a_value_that_means_nothing_is_refused_by_name(name, value, allowed):
    with pytest.raises(TrackingError, match=f"{name} is .*{allowed}"):
        md.TrackerOptions(**{name: value})
    with pytest.raises(TrackingError, match=name):
        replace(md.TrackerOptions(), **{name: value})


def test_options_within_options_are_checked_and_may_be_left_open():
    with pytest.raises(TrackingError, match="work is -1"):
        LoadOptions(work=-1.0)
    with pytest.raises(TrackingError, match="max_iterations is 0"):
        EstimationOptions(max_iterations=0)
    assert LoadOptions(work=None).work is None


def test_the_outline_counts_where_texture_does_not():
    assert md.TrackerOptions(use_texture=False).use_outline
    assert not md.TrackerOptions().use_outline


def test_paths_of_a_run_may_be_text():
    run = md.TrackOptions(
        frames="film.mp4",
        model="m.morph",
        camera="camchain.yaml#cam0",
        output="run",
        landmarks="l.csv",
        inner="tumour.h5",
        other_cameras=["left", "right"],
        reregister_at=[(7, "l7.csv"), (9, None)],
        initializer=InitializerFiles(guess="g.toml"),
    )
    assert (run.model, run.landmarks, run.registration) == (Path("m.morph"), Path("l.csv"), None)
    assert (run.inner, run.other_cameras) == ((Path("tumour.h5"),), (Path("left"), Path("right")))
    assert run.reregister_at == ((7, Path("l7.csv")), (9, None))
    assert run.initializer.guess == Path("g.toml")
    assert (run.folders, run.stream_names) == ((Path("run"),), ("m",))
    # These are no mere paths.
    assert (run.frames, run.camera) == ("film.mp4", "camchain.yaml#cam0")


def test_frames_become_reference_views_where_there_is_room_for_one_beside_the_first():
    assert md.TrackerOptions().makes_views
    assert not md.TrackerOptions(max_views=1).makes_views
    assert not md.TrackerOptions(new_views=False).makes_views
