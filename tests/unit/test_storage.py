"""The model file: what is read back, and every kind of damage refused."""

import h5py
import numpy as np
import pytest

from morph_dslam.errors import ModelFileError
from morph_dslam.model import load_model, save_model
from tests.support.bent_sheet import bent_sheet_model


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(7, 5)


@pytest.fixture
def path(tmp_path, model):
    save_model(tmp_path / "sheet.morph", model)
    return tmp_path / "sheet.morph"


def assert_same(loaded, model):
    assert (loaded.name, loaded.parameters) == (model.name, model.parameters)
    assert (loaded.certificate, loaded.provenance) == (model.certificate, model.provenance)
    np.testing.assert_array_equal(loaded.nodes, model.nodes)
    np.testing.assert_array_equal(loaded.triangles, model.triangles)
    assert loaded.stresses.keys() == model.stresses.keys()
    mu = np.array([0.03, 0.2, -0.1])
    np.testing.assert_allclose(loaded.positions(mu), model.positions(mu), atol=1e-8)  # single precision modes
    for face in model.stresses:
        np.testing.assert_allclose(loaded.von_mises(mu, face), model.von_mises(mu, face), rtol=1e-5)


def test_a_saved_model_is_read_back(path, model):
    assert_same(load_model(path), model)
    assert [file.name for file in path.parent.iterdir()] == ["sheet.morph"]


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_file_cut_short_is_refused(path, fraction):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(fraction * len(whole))])
    with pytest.raises(ModelFileError, match=r"sheet\.morph is damaged or cut short.*build it again"):
        load_model(path)


@pytest.mark.parametrize(("version", "advice"), [(3, "update morph-dslam"), (0, "build it again")])
def test_another_version_is_refused(path, version, advice):
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = version
    with pytest.raises(
        ModelFileError, match=f"version {version}, this release reads versions 1 to 2: {advice}"
    ):
        load_model(path)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ModelFileError, match=r"there is no model file .*absent\.morph"):
        load_model(tmp_path / "absent.morph")
    with pytest.raises(ModelFileError, match="there is no model file"):
        load_model(tmp_path)
    (tmp_path / "text.morph").write_text("not a model")
    with pytest.raises(ModelFileError, match="damaged or cut short"):
        load_model(tmp_path / "text.morph")
    with h5py.File(tmp_path / "other.morph", "w") as file:
        file["nodes"] = np.zeros(3)
    with pytest.raises(ModelFileError, match="HDF5 file but not a morph-dslam model"):
        load_model(tmp_path / "other.morph")


def test_damaged_bytes_are_refused_or_harmless(path, model):
    whole = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    rng = np.random.default_rng(5)
    refused = 0
    for position in rng.integers(len(whole), size=300):
        damaged = whole.copy()
        damaged[position] ^= rng.integers(1, 256, dtype=np.uint8)
        path.write_bytes(damaged.tobytes())
        try:
            loaded = load_model(path)
        except ModelFileError:
            refused += 1
        else:
            assert_same(loaded, model)  # the byte lay in the file's unused space
    assert refused > 100


def change(path, edit):
    """Edit a file and renew its checksum, as a faulty writer would."""
    from morph_dslam.model.storage import _content_hash

    with h5py.File(path, "r+") as file:
        edit(file)
        file.attrs["content_sha256"] = _content_hash(file)


def test_arrays_that_do_not_fit_are_refused(path):
    def shorten(file):
        values = file["nodes"][()]
        del file["nodes"]
        file["nodes"] = values[:-1]

    change(path, shorten)
    with pytest.raises(ModelFileError, match=r"triangles name nodes that do not exist"):
        load_model(path)


def test_values_that_are_not_finite_are_refused(path):
    def spoil(file):
        file["fields/displacement/modes"][0, 0, 0] = np.nan

    change(path, spoil)
    with pytest.raises(ModelFileError, match="not finite"):
        load_model(path)


def test_a_group_in_place_of_a_dataset_is_refused(path):
    def replace(file):
        del file["nodes"]
        file.create_group("nodes")

    change(path, replace)
    with pytest.raises(ModelFileError, match="'nodes' is not a dataset"):
        load_model(path)
