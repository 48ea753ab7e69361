"""A tiny study through the whole offline chain: build, resume, certificate, failures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.gripped_sheet import GrippedSheet
from morph_dslam.model import load_model
from morph_dslam.studies.build import build
from morph_dslam.studies.executors import SerialExecutor
from morph_dslam.studies.sampling import sample_box
from morph_dslam.studies.snapshots import load_snapshot
from morph_dslam.studies.study import load_study

STUDY = """
name = "tiny sheet"
[sheet]
length = "200 mm"
width = "100 mm"
thickness = "0.2 mm"
[material]
young_fibre = "3 GPa"
young_cross = "2 GPa"
poisson = 0.2
shear = "1 GPa"
[grips]
depth = "10 mm"
height = "100 mm"
[parameters]
bulge = ["-12 mm", "12 mm"]
bend = [0.6, 1.1]
skew = ["-4 deg", "4 deg"]
slant = [-0.02, 0.02]
[solver]
divisions = [5, 2]
order = 2
[sampling]
training = 24
held_out = 8
[reduction]
max_degree = 3
grid = [20, 10]
"""


class InProcess(SerialExecutor):
    """Counts what it runs."""

    count = 0

    def submit(self, fn, /, *args, **kwargs):
        self.count += 1
        return super().submit(fn, *args, **kwargs)


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("build")
    (folder / "study.toml").write_text(STUDY)
    build(folder / "study.toml", folder / "tiny.morph", executor=InProcess())
    return folder


def test_model_predicts_solutions_that_it_has_not_seen(built: Path) -> None:
    """Solve anew at random parameters and compare displacement, stress and differences of solutions."""
    model = load_model(built / "tiny.morph")
    study = load_study(built / "study.toml")
    problem = study.problem()
    points = model.nodes[:, :2]
    rng = np.random.default_rng(11)
    start = problem.first_state(0.006)
    for _ in range(3):
        mu = model.lower + (model.upper - model.lower) * rng.uniform(0.1, 0.9, 4)
        mu[0] = abs(mu[0]) + 1e-3
        state = problem.advance(start, mu)
        displacement, stress = problem.shell.sample(state.dofs, points)
        largest = np.abs(displacement).max()
        assert np.linalg.norm(model.displacement.value(mu) - displacement, axis=1).mean() < 5e-3 * largest
        difference = model.stresses["top"].value(mu) - stress["top"]
        assert np.linalg.norm(difference) < 0.1 * np.linalg.norm(stress["top"])
        step = np.array([1e-4, 0.0, 0.0, 0.0])
        ahead, behind = problem.solve(mu + step, state), problem.solve(mu - step, state)
        slope = problem.shell.sample((ahead.dofs - behind.dofs) / 2e-4, points)[0]
        _, slopes = model.displacement.value_and_sensitivities(mu)
        assert np.linalg.norm(slopes[0] - slope) < 0.02 * np.linalg.norm(slope)


def test_certificate_is_in_the_file(built: Path) -> None:
    certificate = load_model(built / "tiny.morph").certificate
    assert certificate["samples"] == {"training": 24, "held_out": 8, "failed": []}
    assert 0.0 < certificate["displacement"]["mean_relative_to_largest"] < 5e-3
    assert set(certificate["sensitivity"]) == {"bulge", "bend", "skew", "slant"}
    assert certificate["compression_percent"] < 100.0


def test_interrupted_build_solves_only_what_is_missing(built: Path) -> None:
    folder = built / "tiny.morph.snapshots"
    files = sorted(folder.glob("*.npz"))
    assert len(files) == 32
    before = load_model(built / "tiny.morph").displacement.value(np.array([0.01, 0.9, 0.02, 0.0]))
    for path in files[::10]:
        path.unlink()
    counted = InProcess()
    build(built / "study.toml", built / "tiny.morph", executor=counted)
    assert counted.count == len(files[::10])
    after = load_model(built / "tiny.morph").displacement.value(np.array([0.01, 0.9, 0.02, 0.0]))
    assert after == pytest.approx(before, abs=1e-7)


def give_up_above(bulge: float, monkeypatch) -> None:
    """The solver gives up above so large a bulge."""
    solve = GrippedSheet.solve

    def limited(self, coordinates, start):
        if coordinates[0] > bulge:
            raise SolverError("beyond the limit point")
        return solve(self, coordinates, start)

    monkeypatch.setattr(GrippedSheet, "solve", limited)


@pytest.mark.slow
def test_failed_samples_are_named_and_the_rest_is_kept(built: Path, tmp_path: Path, monkeypatch) -> None:
    """A solver that gives up above a bulge of 11 mm: the model is still built, the certificate says so."""
    give_up_above(11e-3, monkeypatch)
    (tmp_path / "study.toml").write_text(STUDY)
    build(tmp_path / "study.toml", tmp_path / "tiny.morph", executor=InProcess())
    failed = load_model(tmp_path / "tiny.morph").certificate["samples"]["failed"]
    assert failed
    assert all(abs(entry["coordinates"][0]) > 11e-3 for entry in failed)
    assert all("beyond the limit point" in entry["reason"] for entry in failed)


@pytest.mark.slow
def test_hopeless_range_is_refused_and_solved_samples_stay(tmp_path: Path, monkeypatch) -> None:
    give_up_above(6.1e-3, monkeypatch)
    (tmp_path / "study.toml").write_text(STUDY.replace('"12 mm"', '"60 mm"').replace("-12 mm", "-60 mm"))
    with pytest.raises(StudyError, match=r"of 32 samples could be solved; the first failure: beyond .* kept in"):
        build(tmp_path / "study.toml", tmp_path / "tiny.morph", executor=InProcess())
    assert list((tmp_path / "tiny.morph.snapshots").glob("*.npz"))
    assert not (tmp_path / "tiny.morph").exists()


@pytest.mark.parametrize("which", [1, 2, 3, 4, 7])
def test_mirrored_snapshots_are_solutions(built: Path, which: int) -> None:
    """Solve at the mirrored coordinates directly and compare everything."""
    study = load_study(built / "study.toml")
    problem = study.sweep_problem()
    snapshot = next(
        snapshot
        for path in sorted((built / "tiny.morph.snapshots").glob("*.npz"))
        if (snapshot := load_snapshot(path)).coordinates[0] > 4e-3
    )
    mirrored = study.images(snapshot)[which]
    side = np.sign(mirrored.coordinates[0])
    state = problem.advance(problem.sheet.first_state(6e-3 * side), mirrored.coordinates)
    other = problem.take_snapshot(state)
    assert mirrored.outputs["motion"] == pytest.approx(other.outputs["motion"], abs=1e-7)
    assert mirrored.fields["displacement"] == pytest.approx(other.fields["displacement"], abs=1e-7)
    for name in ("force_left", "moment_left", "force_right", "moment_right"):
        size = np.abs(other.outputs[name]).max()
        assert mirrored.outputs[name] == pytest.approx(other.outputs[name], abs=1e-3 * size)
        ours, theirs = (snapshot.sensitivities[f"reaction_{name}"] for snapshot in (mirrored, other))
        assert ours == pytest.approx(theirs, abs=2e-3 * np.abs(theirs).max())
    ours, theirs = mirrored.sensitivities["displacement"], other.sensitivities["displacement"]
    assert np.abs(ours - theirs).max() < 1e-3 * np.abs(theirs).max()
    for face in ("stress_top", "stress_bottom"):
        ours, theirs = mirrored.fields[face], other.fields[face]
        # Where stresses jump between elements, the two grids see the jump from slightly different sides.
        assert np.abs(ours - theirs).max() < 1e-3 * np.abs(theirs).max()
        ours, theirs = mirrored.sensitivities[face], other.sensitivities[face]
        assert np.abs(ours - theirs).max() < 2e-3 * np.abs(theirs).max()


def test_changed_study_solves_again_only_what_it_must(built: Path) -> None:
    """Another polynomial degree needs no solve at all; the study text is part of the model file."""
    text = STUDY.replace("max_degree = 3", "max_degree = 2")
    (built / "coarser.toml").write_text(text)
    counted = InProcess()
    build(built / "coarser.toml", built / "tiny.morph", executor=counted)
    assert counted.count == 0
    model = load_model(built / "tiny.morph")
    assert set(model.certificate["reduction"]["cross_validation"]) == {"2"}
    assert "max_degree = 2" in model.provenance["study"]
    json.dumps(model.provenance)


def test_samples_are_canonical(built: Path) -> None:
    """The tiny sheet's grips are at the middle of its edges: one octant of the box stands for all."""
    study = load_study(built / "study.toml")
    assert np.all(study.canonical(sample_box(study, 32, 0, 0.5))[:, [0, 2, 3]] >= 0.0)
