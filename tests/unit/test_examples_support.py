"""What the examples have in common: products that are kept, and the frame in which truth is bound."""

import numpy as np
import pytest
from examples.support import Recording, keep, keep_sequence

from morph_dslam import MorphError


def test_a_product_is_made_once_for_the_same_ingredients(tmp_path, capsys):
    study, product = tmp_path / "study.toml", tmp_path / "new" / "sheet.morph"
    study.write_text("thickness = 1")
    made = []

    def make():
        made.append(study.read_text())
        product.write_text("model")

    assert keep(product, [study], make)
    assert not keep(product, [study], make)
    assert str(product) in capsys.readouterr().out
    study.write_text("thickness = 2")
    assert keep(product, [study], make)
    product.unlink()
    assert keep(product, [study], make)
    assert made == ["thickness = 1", "thickness = 2", "thickness = 2"]


def test_a_product_whose_making_failed_is_made_again(tmp_path):
    study, product = tmp_path / "study.toml", tmp_path / "sheet.morph"
    study.write_text("a")
    keep(product, [study], lambda: product.write_text("whole"))

    def fail():
        product.write_text("half")
        raise KeyboardInterrupt

    study.write_text("b")
    with pytest.raises(KeyboardInterrupt):
        keep(product, [study], fail)
    study.write_text("a")
    assert keep(product, [study], lambda: product.write_text("whole"))
    assert product.read_text() == "whole"


@pytest.mark.parametrize(
    ("wanted", "expected"), [((None, None), 9), ((9, 100), 9), ((10, None), 17), ((None, 20), 9), ((20, 40), 25)]
)
def test_truth_is_bound_in_the_first_frame_of_the_range(tmp_path, wanted, expected):
    path = tmp_path / "truth.npz"
    frames = np.array([9, 17, 25, 33])
    np.savez(path, frame=frames, points_mm=np.ones((4, 5, 3)), pixels=np.ones((4, 5, 2)))
    assert Recording(tmp_path, tmp_path, tmp_path, path, wanted).first_truth_frame == expected


def test_a_range_without_truth_is_refused(tmp_path):
    path = tmp_path / "truth.npz"
    np.savez(path, frame=np.array([9]), points_mm=np.ones((1, 5, 3)), pixels=np.ones((1, 5, 2)))
    with pytest.raises(MorphError, match=r"has no frame in the range tracked; it has \[9\]"):
        Recording(tmp_path, tmp_path, tmp_path, path, (10, 20)).first_truth_frame  # noqa: B018


def test_a_scene_that_is_not_there_is_named(tmp_path):
    model, film = tmp_path / "seal.morph", tmp_path / "recording"
    model.write_text("a model")
    with pytest.raises(MorphError, match=r"there is no scene file .*other\.toml"):
        keep_sequence(tmp_path / "other.toml", model, film)
    assert not film.exists()
