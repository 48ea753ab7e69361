"""The page on programs of one's own: its samples in turn, on a rendered sheet with known states."""

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.io.camera_files import save_rig
from tests.support.bent_sheet import bent_sheet_model
from tests.support.documents import samples
from tests.support.rendered_sequence import CAMERA, RIG, SheetFilm, sheet_state, write_landmarks, write_recording

STEP = 0.02


def hand(column):
    """Mask (h, w) of a disc of 60 px in the picture."""
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.hypot(columns - column, rows - 240) < 60.0


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """What the samples leave: their names, and the true state of the picture that each of them saw last."""
    folder, model = tmp_path_factory.mktemp("own"), bent_sheet_model(22, 16)
    film, taken, both, last = SheetFilm(model), [], [], {}

    def grab(rgb=False):
        taken.append(sheet_state(STEP * len(taken)))
        return film.frame(taken[-1])[:, :, :: -1 if rgb else 1].copy()

    rig_films = [SheetFilm(model, part.camera) for part in RIG]

    def grab_all():
        both.append(sheet_state(STEP * len(both)))
        return [shown.frame(part.seen(both[-1]), noise=6.0) for shown, part in zip(rig_films, RIG, strict=True)]

    names = {"grab_all": grab_all} | {
        "grab": grab,
        "segment": lambda _: hand(300),
        "first_picture": film.frame(sheet_state(0.0)),
    }
    write_recording(folder, {}, model)
    write_landmarks(folder / "landmarks.csv", model, sheet_state(0.0))
    for number, part in enumerate(RIG):
        write_landmarks(folder / f"landmarks_{number}.csv", model, part.seen(sheet_state(0.0)), part.camera, count=24)
    save_rig(folder / "camchain.yaml", [(part.camera, part.camera_from_rig) for part in RIG])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for number, program in enumerate(samples("own-program", "python")):
            exec(compile(program, f"own-program, sample {number + 1}", "exec"), names)
            last[number] = taken[-1]
    return folder, names, last


def test_a_point_is_where_the_truth_has_it(page):
    """Its displacement and pixel, from the state that the picture was rendered in."""
    _, names, last = page
    model, truth = names["model"], last[4]
    state = model.at(truth.parameters)
    true = state.displacement(names["points"])
    np.testing.assert_allclose(names["displacement"], true, atol=1e-3)
    assert (np.abs(names["displacement"] - true) < 5.0 * names["deviation"] + 1e-5).all()
    pixels = CAMERA.project(truth.camera_from_object.apply(state.positions(names["points"])))
    np.testing.assert_allclose(names["pixels"], pixels, atol=0.5)
    assert names["stress"].shape == (2,)


def test_the_other_samples_do_what_the_page_says(page):
    folder, names, _ = page
    assert (folder / "drawn.png").is_file()
    assert all(result.tracked for result in names["results"].values())
    assert [each.frame.index for each in names["found"]] == [0, 1, 2]
    assert all(result.tracked for each in names["found"] for result in each.results.values())
    assert sorted(path.name for path in (folder / "states").glob("*.vtu"))[-1].endswith("_0004.vtu")
    np.testing.assert_allclose(names["state"].parameters, [0.020, 0.3, 0.0])


def test_a_rig_finds_the_state_that_both_cameras_saw(page):
    """By landmarks and pictures of both; each frame's truth is what it was rendered in."""
    _, names, _ = page
    truth, found = sheet_state(STEP), names["together"]
    assert found.tracked
    assert not found.warnings
    away = found.estimate.state.parameters - truth.parameters
    assert (np.abs(away) < 4.0 * found.estimate.parameter_std).all()
    exact = truth.camera_from_object.apply(names["model"].positions(truth.parameters))
    assert np.linalg.norm(found.positions() - exact, axis=1).mean() < 0.5e-3


AS_DEPTH = {
    "infinite": lambda mask: np.where(mask, np.float32(0.1), np.float32(np.inf)),
    "nan": lambda mask: np.where(mask, 0.1, np.nan),
    "zero": lambda mask: np.where(mask, 0.1, 0.0),
}


def tracked_behind(names, occluders):
    """Results and true parameters of pictures through which a disc of noise moves."""
    film, noise = SheetFilm(names["model"]), np.random.default_rng(1)
    tracker = md.Tracker(names["model"], names["camera"], names["start"], reference=names["first_picture"])
    results, truths = [], []
    for step in range(6):
        truth, mask = sheet_state(STEP * step), hand(150 + 60 * step)
        picture = film.frame(truth).copy()
        picture[mask] = noise.integers(0, 255, (int(mask.sum()), 3))
        results.append(tracker.track(picture, occluder_depth=occluders(mask)))
        truths.append(truth.parameters)
    return results, np.array(truths)


def test_a_mask_of_what_hides_the_object_keeps_it_out(page):
    _, names, _ = page
    results, truths = tracked_behind(names, lambda mask: mask)
    assert all(result.tracked for result in results)
    found = np.array([list(result.parameters.values()) for result in results])
    deviations = np.array([list(result.parameter_std.values()) for result in results])
    assert (np.abs(found - truths) < 5.0 * deviations + 1e-5).all()


def test_depth_of_what_hides_it_may_say_nothing_in_several_ways(page):
    _, names, _ = page
    found = [
        [list(result.parameters.values()) for result in tracked_behind(names, occluders)[0]]
        for occluders in AS_DEPTH.values()
    ]
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])


@pytest.mark.parametrize(
    "occluders",
    [lambda mask: mask.tolist(), lambda mask: mask[::2, ::2], lambda mask: 255 * mask.astype(np.uint8)],
    ids=["list", "half the size", "uint8"],
)
def test_what_is_no_mask_and_no_depth_is_refused(page, occluders):
    _, names, _ = page
    with pytest.raises(md.MorphError, match=r"occluder_depth \(a mask is an array of bool\) is"):
        tracked_behind(names, occluders)
