"""The model file: read back in every format; faulty writers and a thousand damaged files are refused."""

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.errors import ArgumentError, ModelFileError
from morph_dslam.io.checksum import write_checksum
from morph_dslam.model import SeparatedField, load_model, save_model
from tests.support.bent_sheet import bent_sheet_model
from tests.support.function_formats import FORMATS, OTHERS, SMOOTH, make_functions
from tests.support.small_models import block_model


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
    assert loaded.cells.keys() == model.cells.keys()
    for name, connectivity in model.cells.items():
        np.testing.assert_array_equal(loaded.cells[name], connectivity)
    assert loaded.fields.keys() == model.fields.keys()


def test_a_saved_model_is_read_back(path, model):
    loaded = load_model(path)
    assert_same(loaded, model)
    assert [file.name for file in path.parent.iterdir()] == ["sheet.morph"]
    mu = np.array([0.03, 0.2, -0.1])
    np.testing.assert_allclose(loaded.positions(mu), model.positions(mu), atol=1e-8)  # single precision modes
    for face in model.stresses:
        np.testing.assert_allclose(loaded.von_mises(mu, face), model.von_mises(mu, face), rtol=1e-5)


def test_stress_without_a_place_is_that_of_the_top_in_memory_and_from_a_file(path, model):
    mu = np.array([0.03, 0.2, -0.1])
    for one in (model, replace(model, stresses=dict(reversed(model.stresses.items()))), load_model(path)):
        np.testing.assert_allclose(one.at(mu).stress(), model.stresses["top"].value(mu), rtol=1e-5)


def test_the_same_model_gives_the_same_bytes(path, model, tmp_path):
    save_model(tmp_path / "again.morph", model)
    assert (tmp_path / "again.morph").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("bases", [SMOOTH, OTHERS], ids=["smooth bases", "other bases"])
def test_every_format_and_basis_is_read_back(tmp_path, form, bases):
    model = block_model(form, bases)
    save_model(tmp_path / "block.morph", model)
    loaded = load_model(tmp_path / "block.morph")
    assert_same(loaded, model)
    for name, field in model.fields.items():
        found = loaded.fields[name]
        assert type(found.functions) is type(field.functions)
        assert found.n_floats == field.n_floats
        for mu in np.random.default_rng(1).uniform(model.lower, model.upper, (5, 3)):
            value, slopes = field.value_and_sensitivities(mu)
            again, again_slopes = found.value_and_sensitivities(mu)
            assert np.abs(again - value).max() < 1e-6 * np.abs(value).max()
            assert np.abs(again_slopes - slopes).max() < 1e-6 * np.abs(slopes).max()


def change(path, edit):
    """Edit a file and renew its checksum, as a faulty writer would."""
    with h5py.File(path, "r+") as file:
        edit(file)
    write_checksum(path, "morph-dslam reduced model")


def by_component(file, components=(0, 1, 1, 2, 2, 2), count=3):
    """The displacement as releases before 0.2.0 could write it: each mode moves one component."""
    group = file["fields/displacement"]
    values = group["modes"][:, :, 0]
    del group["modes"]
    group["modes"], group["components"] = values, np.array(components, dtype=np.uint8)
    group.attrs["modes"], group.attrs["n_components"] = "by_component", count


def test_modes_by_component_are_read(tmp_path):
    model = block_model("tucker")
    save_model(tmp_path / "block.morph", model)
    change(tmp_path / "block.morph", by_component)
    modes = np.moveaxis(load_model(tmp_path / "block.morph").displacement.modes, 2, 1)
    for mode, component, first in zip(modes, (0, 1, 1, 2, 2, 2), model.displacement.modes[:, :, 0], strict=True):
        np.testing.assert_allclose(mode[component], first, rtol=1e-6)
        assert not np.delete(mode, component, axis=0).any()


@pytest.mark.parametrize(("version", "advice"), [(4, "update morph-dslam"), (0, "build it again")])
def test_another_version_is_refused(path, version, advice):
    change(path, lambda file: file.attrs.__setitem__("version", version))
    with pytest.raises(ModelFileError, match=f"version {version}, this release reads version 3: {advice}"):
        load_model(path)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ModelFileError, match=r"there is no model file .*absent\.morph"):
        load_model(tmp_path / "absent.morph")
    with pytest.raises(ModelFileError, match="there is no model file"):
        load_model(tmp_path)
    (tmp_path / "text.morph").write_text("not a model")
    with pytest.raises(ModelFileError, match=r"damaged or cut short .*does not begin as such a file"):
        load_model(tmp_path / "text.morph")
    with h5py.File(tmp_path / "other.morph", "w") as file:
        file["nodes"] = np.zeros(3)
    with pytest.raises(ModelFileError, match="HDF5 file but not a morph-dslam model"):
        load_model(tmp_path / "other.morph")


def put(name, values):
    def edit(file):
        if name in file:
            del file[name]
        file[name] = values

    return edit


def set_attribute(place, name, value):
    return lambda file: file[place].attrs.__setitem__(name, value)


def remove(name):
    return lambda file: file.__delitem__(name)


def into_group(name):
    def edit(file):
        del file[name]
        file.create_group(name)

    return edit


def giant(file):
    """A dataset of 8 TB that has no data in the file: HDF5 would fill it with zeros."""
    del file["fields/strain/modes"]
    file.create_dataset("fields/strain/modes", shape=(6, 1 << 38, 6), dtype="f4")


PARAMETERS = '[{"name": "a", "quantity": "ratio", "unit": "1", "lower": %s, "upper": %s, "default": 0.0}]'
FUNCTIONS = "fields/displacement/functions"
FAULTS = [
    ("tucker", put("nodes", np.zeros((2, 3))), "triangles name nodes that do not exist"),
    ("tucker", put("nodes", np.zeros((8, 2))), "nodes are not finite points"),
    ("tucker", put("nodes", np.full((27, 3), np.nan)), "'nodes' holds values that are not finite"),
    ("tucker", remove("nodes"), "'nodes' is not a dataset"),
    ("tucker", into_group("nodes"), "'nodes' is not a dataset"),
    ("tucker", put("triangles", np.array([[0, 1, -1]])), "triangles name nodes that do not exist"),
    ("tucker", put("triangles", np.array([[0.0, 1.0, 2.0]])), "'triangles' holds float64"),
    ("tucker", put("cells/hex8", np.array([[0, 1, 2, 3]])), "hex8 cells do not have 8 nodes"),
    ("tucker", put("cells/hex8", np.full((1, 8), 99)), "hex8 cells name nodes that do not exist"),
    ("tucker", put("cells/9", np.zeros((1, 8), int)), "'9' is not a type of cell"),
    ("tucker", put("fields/colour/modes", np.zeros(3)), "'functions' is not a group"),
    ("tucker", lambda file: file.move("fields/strain", "fields/colour"), "fields colour are not known"),
    ("tucker", remove("fields/displacement"), "displacement"),
    ("tucker", put("fields/strain/modes", np.zeros((6, 27, 5))), "field 'strain' has modes of shape"),
    ("tucker", put("fields/strain/modes", np.zeros((5, 27, 6))), "6 functions of 3 parameters, but 5 modes"),
    ("tucker", giant, "announces .* more than the file has"),
    ("tucker", set_attribute("fields/strain", "modes", "wavelet"), "unknown form 'wavelet'"),
    ("tucker", set_attribute(FUNCTIONS, "format", "neural"), "unknown format 'neural'"),
    ("tucker", set_attribute(FUNCTIONS, "format", 3), "'format' is not a text"),
    ("tucker", put(f"{FUNCTIONS}/core", np.zeros((6, 2, 3, 5))), r"ranks \(2, 3, 2\), the core"),
    ("tucker", put(f"{FUNCTIONS}/factor_2", np.zeros((4, 3))), "functions, the coefficients"),
    ("tucker", set_attribute(f"{FUNCTIONS}/basis_1", "kind", "wavelet"), "a basis is one of"),
    ("tucker", set_attribute(f"{FUNCTIONS}/basis_1", "size", 2**40), "need .* finite knots"),
    ("tucker", set_attribute(f"{FUNCTIONS}/basis_1", "degree", 7), "cannot be of degree 7"),
    ("tucker", set_attribute(f"{FUNCTIONS}/basis_1", "upper", np.inf), "'upper' is not a finite number"),
    ("tucker", set_attribute(f"{FUNCTIONS}/basis_2", "upper", -1.0), "must grow"),
    ("tucker", set_attribute(f"{FUNCTIONS}/basis_2", "upper", 0.9), "do not cover the ranges"),
    ("tucker", put(f"{FUNCTIONS}/basis_1/knots", np.zeros(10)), "must grow from its lower"),
    ("cp", put(f"{FUNCTIONS}/mixing", np.zeros((4, 6))), "the mixing 4"),
    ("cp", put(f"{FUNCTIONS}/mixing", np.full((5, 6), np.inf)), "'mixing' holds values that are not finite"),
    ("tensor_train", put(f"{FUNCTIONS}/core_2", np.zeros((9, 5, 2))), "do not follow each other"),
    ("polynomial", put(f"{FUNCTIONS}/multi_indices", np.full((35, 3), -1)), "negative degree"),
    ("polynomial", put(f"{FUNCTIONS}/coefficients", np.zeros((34, 6))), "do not fit together"),
    ("tucker", lambda file: by_component(file, (3,) * 6), "is not one of 3"),
    ("tucker", lambda file: by_component(file, (0,) * 5), "5 components, each one of 3, do not fit"),
    ("tucker", lambda file: by_component(file, count=2**40), "each one of 1099511627776, do not fit"),
    ("tucker", set_attribute("/", "parameters", PARAMETERS % (1.0, -1.0)), "has the lower end"),
    ("tucker", set_attribute("/", "parameters", PARAMETERS % (-1.0, "NaN")), "has the lower end"),
    ("tucker", set_attribute("/", "parameters", PARAMETERS % (-1.0, '"b"')), "not numbers"),
    ("tucker", set_attribute("/", "parameters", "[]"), "'core' holds"),
    ("tucker", set_attribute("/", "parameters", "["), "damaged"),
    ("tucker", set_attribute("/", "certificate", 3), "'certificate' is not a text"),
]  # fmt: skip


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    folder = tmp_path_factory.mktemp("originals")
    for form in {form for form, _, _ in FAULTS}:
        save_model(folder / f"{form}.morph", block_model(form))
    return folder


@pytest.mark.parametrize(("form", "edit", "message"), FAULTS)
def test_the_file_of_a_faulty_writer_is_refused(originals, tmp_path, form, edit, message):
    path = Path(shutil.copy(originals / f"{form}.morph", tmp_path))
    change(path, edit)
    with pytest.raises(ModelFileError, match=message):
        load_model(path)


def test_a_model_that_does_not_fit_together_is_not_written(tmp_path, model):
    modes = np.zeros((3, len(model.nodes), 6))
    unfit = SeparatedField(modes, make_functions("tucker", 3))
    with pytest.raises(ValueError, match="do not cover the ranges"):
        save_model(tmp_path / "unfit.morph", replace(model, strain=unfit))
    large = model.displacement.with_modes(np.full_like(model.displacement.modes, 1e300))
    with pytest.raises(ValueError, match="not finite in single precision"):
        save_model(tmp_path / "large.morph", replace(model, displacement=large))
    assert not list(tmp_path.glob("*.morph"))


# Damaged files: bytes changed, and parts changed through HDF5 itself.

OF_BYTES = ("bit", "bits", "byte", "cut", "longer", "zeros", "noise", "moved", "swapped")
OF_CONTENT = ("dataset", "attribute", "version")
KINDS = OF_BYTES + OF_CONTENT
#: Damages of every kind for every form: 4 x 12 x 21 = 1 008.
REPEATS = 21


def damage_bytes(whole, kind, rng):
    data = np.frombuffer(whole, dtype=np.uint8).copy()
    n = len(data)
    start = int(rng.integers(n - 1))
    stop = min(n, start + int(rng.integers(1, 2000)))
    if kind == "bit":
        data[start] ^= 1 << rng.integers(8)
    elif kind == "bits":
        np.bitwise_xor.at(data, rng.integers(n, size=30), (1 << rng.integers(8, size=30)).astype(np.uint8))
    elif kind == "byte":
        data[start] ^= rng.integers(1, 256, dtype=np.uint8)
    elif kind == "cut":
        data = data[:start]
    elif kind == "longer":
        data = np.concatenate([data, rng.integers(256, size=stop - start, dtype=np.uint8)])
    elif kind == "zeros":
        data[start:stop] = 0
    elif kind == "noise":
        data[start:stop] = rng.integers(256, size=stop - start, dtype=np.uint8)
    elif kind == "moved":
        data = np.concatenate([data[:start], data[stop:]])
    elif kind == "swapped":
        other = int(rng.integers(n - (stop - start) + 1))
        length = stop - start
        one, two = data[start:stop].copy(), data[other : other + length].copy()
        data[start:stop], data[other : other + length] = two, one
    return data.tobytes()


def members(file, kind):
    found = []
    file.visititems(lambda name, item: found.append(name) if isinstance(item, kind) else None)
    return found


def damage_content(path, kind, rng):
    """Change a part of the file through HDF5 itself, which leaves a sound HDF5 file."""
    with h5py.File(path, "r+") as file:
        if kind == "version":
            file.attrs["version"] = int(rng.choice([-1, 0, 1, 2, 4, 99]))
        elif kind == "dataset":
            name = rng.choice(members(file, h5py.Dataset))
            values = file[name][()]
            del file[name]
            if rng.random() < 0.5:
                file[name] = rng.permuted(values.ravel()).reshape(values.shape[::-1]) + 1
        else:
            place = file[rng.choice(["/", *members(file, h5py.Group)])]
            if len(place.attrs):
                name = rng.choice(list(place.attrs))
                old = place.attrs[name]
                place.attrs[name] = old + "x" if isinstance(old, str) else old + 1
            else:
                place.attrs["new"] = 1


def assert_exactly_the_same(loaded, model):
    assert_same(loaded, model)
    middle = (model.lower + model.upper) / 2.0
    for name, field in model.fields.items():
        found = loaded.fields[name].value_and_sensitivities(middle)
        for one, other in zip(found, field.value_and_sensitivities(middle), strict=True):
            np.testing.assert_array_equal(one, other)


def refused_or_unharmed(path, model):
    """Whether the file was refused; fails where it loads as another model."""
    try:
        loaded = load_model(path)
    except ModelFileError:
        return True
    assert_exactly_the_same(loaded, model)
    return False


@pytest.mark.parametrize("form", FORMATS)
def test_damaged_files_are_refused(tmp_path, form):
    path, rng = tmp_path / "block.morph", np.random.default_rng(FORMATS.index(form))
    save_model(path, block_model(form))
    whole, model = path.read_bytes(), load_model(path)
    for kind in KINDS:
        refused = 0
        for _ in range(REPEATS):
            path.write_bytes(whole)
            if kind in OF_CONTENT:
                damage_content(path, kind, rng)
            else:
                path.write_bytes(damage_bytes(whole, kind, rng))
            changed = path.read_bytes() != whole
            assert refused_or_unharmed(path, model) == changed
            refused += changed
        assert refused > 0.6 * REPEATS  # zeros over zeros change nothing


@pytest.mark.parametrize("kind", ["bit", "cut"])
def test_the_command_line_says_in_one_message_that_a_file_is_damaged(tmp_path, capsys, kind):
    path = tmp_path / "block.morph"
    save_model(path, block_model("tucker"))
    path.write_bytes(damage_bytes(path.read_bytes(), kind, np.random.default_rng(0)))
    assert cli.main(["info", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(path) in line


def test_arguments_of_another_kind_are_refused(tmp_path):
    model = bent_sheet_model(3, 3)
    with pytest.raises(ArgumentError, match=r"first argument of save_model .* and the model as the second"):
        save_model(model, tmp_path / "sheet.morph")  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="the model file is None: give its path"):
        load_model(None)  # type: ignore[arg-type]
