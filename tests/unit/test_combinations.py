"""What makes no sense together is refused, each in one line, before anything is read or written."""

from dataclasses import replace
from pathlib import Path

import pytest

import morph_dslam as md
from morph_dslam.errors import TrackingError
from morph_dslam.registration.initialization import InitializerFiles
from morph_dslam.tracking.combinations import check_options
from morph_dslam.tracking.drawing import DrawOptions, SectionPlane
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.run_options import ObjectOptions

CSV, JSON, TOML = Path("l.csv"), Path("r.json"), Path("b.toml")
PLAIN = md.TrackOptions(frames="film", camera="c.yaml", model=Path("m.morph"), output=Path("run"), landmarks=CSV)
REGISTERED = {"landmarks": None, "registration": JSON}
BY_BOARD = {"landmarks": None, "initializer": InitializerFiles(board=TOML)}
LID = ObjectOptions(model=Path("lid.morph"), registration=JSON)
FREE_LID = ObjectOptions(model=Path("lid.morph"), landmarks=CSV)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"landmarks": None}, "in one way"),
        ({"registration": JSON}, "in one way"),
        ({"initializer": InitializerFiles(picture=TOML, guess=TOML), "landmarks": None}, "in one way"),
        ({"others": (("lid", replace(LID, landmarks=CSV)),)}, "in one way"),
        ({"tracker": md.TrackerOptions(pose="fixed")}, "--registration"),
        ({"reregister_at": ((7, None),)}, "--reregister-at N=FILE"),
        ({"map_path": Path("map.h5")}, "a map needs"),
        *(({"others": ((name, LID),)}, "plain name") for name in ("", "..", "a/b", "plots")),
        ({"others": (("lid", LID), ("lid", LID))}, "plain name"),
        ({"live": True, "other_cameras": (Path("aside"),)}, "--with"),
        ({"live": True, "refine_reference": True}, "--refine"),
        ({"live": True, "reference_frame": 3}, "--reference-frame"),
        ({"reference_image": Path("i.png")}, "--reference-frame"),
        ({"reference_image": Path("i.png"), "live": True, **REGISTERED}, "--reference-image"),
        ({"serve": 0}, "--serve"),
        ({"seconds": 2.0}, "--seconds"),
        ({"refine_reference": True, **REGISTERED}, "--refine"),
        ({"snap": True, **REGISTERED}, "--snap"),
        ({"snap": True, **BY_BOARD}, "--snap"),
        ({"snap": True, "tracker": TrackerOptions(use_depth=True)}, "--snap"),
        ({"refine_reference": True, **BY_BOARD}, "--refine"),
        ({"refine_reference": True, "reregister_at": ((7, CSV),)}, "--reregister-at"),
        ({"refine_reference": True, "other_cameras": (Path("aside"),)}, "--with"),
        ({"other_cameras": (Path("aside"),), "tracker": TrackerOptions(use_discrepancy=True)}, "--discrepancy"),
        ({"other_cameras": (Path("aside"),), "tracker": TrackerOptions(use_unknown_loads=True)}, "--unknown-loads"),
        ({"tracker": TrackerOptions(use_discrepancy=True), "drawing": DrawOptions("stress")}, "not in equilibrium"),
        ({"depth_per_metre": 1000.0}, "add --depth"),
        ({"refine_camera": ("radial",)}, "--still"),
        ({"refine_camera": ("centre",), "tracker": TrackerOptions(pose="still")}, "focal and radial"),
        ({"reference_frame": 3, **REGISTERED}, "--reference-frame"),
        ({"reference_frame": 3, **REGISTERED, "others": (("lid", LID),)}, "--reference-frame"),
        ({"video": False, "drawing": DrawOptions("strain")}, "--no-video"),
        ({"video": False, "drawing": DrawOptions(section=SectionPlane.parse("x=3"))}, "--no-video"),
        ({"video": False, "drawing": DrawOptions(section=SectionPlane.parse("x=3")), "streams": ("ws",)}, "--no-video"),
        ({"video": False, "drawing": DrawOptions(forces=True), "streams": ("ws",)}, "--forces"),
        ({"tracker": TrackerOptions(random_walk=(("bend", 0.1), ("bend", 0.2)))}, "--random-walk once"),
    ],
)
def test_what_makes_no_sense_together_is_refused(changes, named):
    with pytest.raises(TrackingError, match=named):
        check_options(replace(PLAIN, **changes))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {**REGISTERED, "map_path": Path("map.h5"), "tracker": md.TrackerOptions(pose="fixed")},
        {**BY_BOARD, "reregister_at": ((7, None), (9, CSV)), "live": True, "serve": 0, "seconds": 2.0},
        {"others": (("lid", LID),), "map_path": Path("map.h5"), "reference_frame": 3, "refine_reference": True},
        {"others": (("lid", FREE_LID),), "other_cameras": (Path("aside"),)},
        {**REGISTERED, "reference_frame": 3, "other_cameras": (Path("aside"),)},
        {"live": True, "reference_image": Path("i.png")},
        {"refine_camera": ("focal", "radial"), "tracker": TrackerOptions(pose="still")},
        {"live": True, "others": (("lid", FREE_LID),), "tracker": md.TrackerOptions(use_depth=True)},
        {"video": False, "drawing": DrawOptions("strain"), "streams": ("ws", "ws:0")},
    ],
)
def test_what_makes_sense_is_not_refused(changes):
    check_options(replace(PLAIN, **changes))


def test_streams_call_each_object_by_a_name_of_its_own():
    assert PLAIN.stream_names == ("m",)
    others = tuple((name, LID) for name in ("lid", "m"))
    assert replace(PLAIN, others=others).stream_names == ("m_", "lid", "m")


def test_the_command_line_refuses_before_it_reads(tmp_path, refused):
    arguments = ["track", "film", "--model", "m.morph", "--camera", "c.yaml", "--landmarks", "l.csv", "--no-video"]
    assert "--no-video" in refused(*arguments, "--show", "strain", "-o", tmp_path / "run")
    assert "lid" in refused(*arguments, "--reregister-at", "lid:7=l.csv", "-o", tmp_path / "run")
    assert not (tmp_path / "run").exists()
