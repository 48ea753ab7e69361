"""Snapshot files: names, complete or absent, and damage that is noticed."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from morph_dslam.errors import StudyError, WorkerError
from morph_dslam.studies import snapshots
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.sample_task import solve_sample
from morph_dslam.studies.study import load_study
from tests.support.block_study import write_study


def write(path: Path) -> Snapshot:
    rng = np.random.default_rng(0)
    snapshot = Snapshot(
        np.array([1.0, 2.0]),
        {"displacement": rng.normal(size=(40, 3))},
        {"displacement": rng.normal(size=(2, 40, 3))},
        {"force_end": rng.normal(size=3)},
    )
    snapshots.save_snapshot(path, snapshot, {"dofs": rng.normal(size=55)})
    return snapshot


def test_what_was_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "one.npz"
    written, read = write(path), snapshots.load_snapshot(path)
    np.testing.assert_array_equal(read.coordinates, written.coordinates)
    for got, expected in ((read.fields, written.fields), (read.sensitivities, written.sensitivities)):
        np.testing.assert_array_equal(got["displacement"], expected["displacement"].astype(np.float32))
    np.testing.assert_array_equal(read.outputs["force_end"], written.outputs["force_end"])
    assert snapshots.load_state(path)["dofs"].dtype == np.float64
    assert list(tmp_path.iterdir()) == [path]


def test_fields_are_read_when_asked_for(tmp_path: Path) -> None:
    """A field joined to those on disk is beside them, in order; what another name has is not touched."""
    path = tmp_path / "one.npz"
    written = write(path)
    read = snapshots.load_snapshot(path)
    joined = read.fields | {"reaction": np.ones((1, 3))}
    assert list(joined) == ["displacement", "reaction"]
    assert len(joined) == 2
    assert "slope/displacement" not in joined
    with pytest.raises(KeyError):
        read.fields["reaction"]
    np.testing.assert_array_equal(joined["reaction"], 1.0)
    assert list(read.fields) == ["displacement"]
    other = Snapshot(written.coordinates, {"displacement": np.zeros((40, 3))})
    snapshots.save_snapshot(path, other, {})
    np.testing.assert_array_equal(joined["displacement"], 0.0)


def test_a_write_that_is_cut_short_leaves_no_file(tmp_path: Path, monkeypatch) -> None:
    def killed(descriptor: int) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(os, "fsync", killed)
    with pytest.raises(StudyError, match=r"cannot write .*one\.npz: no space"):
        write(tmp_path / "one.npz")
    assert not list(tmp_path.iterdir())


def test_every_damage_is_noticed(tmp_path: Path) -> None:
    """Files cut at any length, and any bit of an array's data turned."""
    path, copy = tmp_path / "one.npz", tmp_path / "copy.npz"
    write(path)
    assert snapshots.damage(path) is None
    content = path.read_bytes()
    rng = np.random.default_rng(1)
    for length in [0, 1, len(content) - 1, *rng.integers(0, len(content), 50)]:
        copy.write_bytes(content[:length])
        assert snapshots.damage(copy), length
    data = content.index(b"\x93NUMPY") + 128
    for place in rng.integers(data, data + 16, 8):
        turned = bytearray(content)
        turned[place] ^= 1 << int(rng.integers(8))
        copy.write_bytes(turned)
        assert "checksum of coordinates.npy" in str(snapshots.damage(copy))


def test_a_turned_bit_anywhere_is_noticed_or_harmless(tmp_path: Path) -> None:
    """Some bits of a zip archive say nothing, the date of a file for instance: then all arrays are right."""
    path, copy = tmp_path / "one.npz", tmp_path / "copy.npz"
    write(path)
    content, noticed = path.read_bytes(), 0
    with np.load(path) as file:
        arrays = dict(file)
    rng = np.random.default_rng(3)
    for place in np.append(rng.integers(0, len(content), 150), np.arange(len(content) - 400, len(content))):
        turned = bytearray(content)
        turned[place] ^= 1 << int(rng.integers(8))
        copy.write_bytes(turned)
        if snapshots.damage(copy):
            noticed += 1
            continue
        with np.load(copy) as file:
            assert sorted(file.files) == sorted(arrays)
            assert all(np.array_equal(file[name], values) for name, values in arrays.items())
    assert noticed > 200


def test_names_change_with_the_mechanics_alone(tmp_path: Path) -> None:
    def key(*changes: tuple[str, str]) -> str:
        return snapshots.snapshot_key(load_study(write_study(tmp_path, *changes)), point)  # type: ignore[arg-type]

    point = np.array([1e5, 0.0, 3e6])
    kept = [
        ('["0 kPa", "600 kPa"]', '["0 kPa", "500 kPa"]'),
        ("training = 24", "training = 48"),
        ("held_out = 6", "held_out = 12"),
        ("max_degree = 2", "max_degree = 3"),
        ("threads = 1", "threads = 2"),
        ("workers = 1", "workers = 2"),
        ('name = "block"', 'name = "bar"'),
    ]
    changed = [
        ("poisson = 0.3", "poisson = 0.31"),
        ('young = "young"', 'young = "3 MPa"'),
        ("divisions = [1, 1, 3]", "divisions = [1, 1, 4]"),
        ('on = "z_min"', 'on = "x_min"'),
        ('["push", "0 Pa", "pull"]', '["0 Pa", "push", "pull"]'),
        ("[solver]", "[solver]\norder = 2"),
    ]
    first = key()
    assert [key(change) for change in kept] == [first] * len(kept)
    assert len({first, *(key(change) for change in changed)}) == 1 + len(changed)


def test_a_worker_with_other_files_refuses(tmp_path: Path) -> None:
    study = load_study(write_study(tmp_path))
    with pytest.raises(WorkerError, match=r"another release .* or other files"):
        solve_sample(study, "0" * 64, np.zeros(3), None)  # type: ignore[arg-type]
