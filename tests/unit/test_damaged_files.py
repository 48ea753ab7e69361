"""A thousand damaged model files: each is refused with one message, or gives exactly the model it was."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.errors import ModelFileError
from morph_dslam.model import load_model, save_model
from tests.support.function_formats import FORMATS
from tests.support.small_models import block_model

FORMS = [*FORMATS, "by_component", "grid"]
OF_BYTES = ("bit", "bits", "byte", "cut", "longer", "zeros", "noise", "moved", "swapped")
OF_CONTENT = ("dataset", "attribute", "version")
KINDS = OF_BYTES + OF_CONTENT
#: Damages of every kind for every form: 6 x 12 x 14 = 1 008.
REPEATS = 14


def damage_bytes(whole: bytes, kind: str, rng: np.random.Generator) -> bytes:
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


def members(file: h5py.File, kind: type) -> list[str]:
    found: list[str] = []
    file.visititems(lambda name, item: found.append(name) if isinstance(item, kind) else None)
    return found


def damage_content(path, kind: str, rng: np.random.Generator) -> None:
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


def assert_exactly_the_same(loaded, model) -> None:
    assert loaded.parameters == model.parameters
    assert (loaded.certificate, loaded.provenance) == (model.certificate, model.provenance)
    np.testing.assert_array_equal(loaded.nodes, model.nodes)
    np.testing.assert_array_equal(loaded.triangles, model.triangles)
    for name, connectivity in model.cells.items():
        np.testing.assert_array_equal(loaded.cells[name], connectivity)
    assert loaded.fields.keys() == model.fields.keys()
    middle = (model.lower + model.upper) / 2.0
    for name, field in model.fields.items():
        for one, other in zip(
            loaded.fields[name].value_and_sensitivities(middle), field.value_and_sensitivities(middle), strict=True
        ):
            np.testing.assert_array_equal(one, other)


def refused_or_unharmed(path, model) -> bool:
    """Whether the file was refused; fails where it loads as another model."""
    try:
        loaded = load_model(path)
    except ModelFileError:
        return True
    assert_exactly_the_same(loaded, model)
    return False


@pytest.mark.parametrize("form", FORMS)
def test_damaged_files_are_refused(tmp_path, form):
    path, rng = tmp_path / "block.morph", np.random.default_rng(FORMS.index(form))
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


@pytest.mark.parametrize("kind", OF_BYTES)
def test_the_command_line_says_in_one_message_that_a_file_is_damaged(tmp_path, capsys, kind):
    path, rng = tmp_path / "block.morph", np.random.default_rng(KINDS.index(kind))
    save_model(path, block_model("tucker"))
    whole = path.read_bytes()
    for _ in range(3):
        damaged = damage_bytes(whole, kind, rng)
        path.write_bytes(damaged)
        status = cli.main(["info", str(path)])
        printed = capsys.readouterr()
        if damaged == whole:
            assert status == 0
        else:
            assert status == 2
            assert printed.err.startswith(f"morph: {path} is damaged or cut short")
            assert len(printed.err.splitlines()) == 1
