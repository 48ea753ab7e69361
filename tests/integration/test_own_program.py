"""The page on programs of one's own: its samples in turn, on a rendered sheet with known states."""

import numpy as np
import pytest

from tests.support.bent_sheet import bent_sheet_model
from tests.support.documents import samples
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state, write_landmarks, write_recording

STEP = 0.02


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """What the samples leave: their names, and the true state of the picture that each of them saw last."""
    folder, model = tmp_path_factory.mktemp("own"), bent_sheet_model(22, 16)
    film, taken, last = SheetFilm(model), [], {}

    def grab(rgb=False):
        taken.append(sheet_state(STEP * len(taken)))
        return film.frame(taken[-1])[:, :, :: -1 if rgb else 1].copy()

    names = {"grab": grab, "first_picture": film.frame(sheet_state(0.0))}
    write_recording(folder, {}, model)
    write_landmarks(folder / "landmarks.csv", model, sheet_state(0.0))
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
