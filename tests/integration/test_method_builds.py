"""The methods of reduction from study files to certified model files, on tiny solids; choices that do not suit."""

from __future__ import annotations

import json
import re
import tomllib

import ngsolve
import numpy as np
import pytest

from morph_dslam import build, make_study
from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.solvers.continuation import PathError
from morph_dslam.model import load_model
from morph_dslam.reduction import galerkin
from morph_dslam.studies import solutions
from morph_dslam.studies.build import build_warnings
from morph_dslam.studies.defaults import resolve_defaults
from morph_dslam.studies.sampling import training_samples
from tests.support.block_study import STUDY, bent_block, write_study

BLOCK = bent_block(["20 mm", "20 mm", "60 mm"], [2, 2, 6], 0.4, "25 deg", "5 mm") | {
    "sampling": {"held_out": 6, "training": 24, "refined": 0},
    "reduction": {"method": "reduced_basis", "tolerance": 1e-5},
}


@pytest.mark.slow
def test_a_reduced_basis_is_sampled_one_solve_at_a_time(tmp_path) -> None:
    build(make_study(BLOCK), tmp_path / "block.morph")
    certificate = load_model(tmp_path / "block.morph").certificate
    rounds = certificate["samples"]["rounds"]
    assert [r["solves"] for r in rounds] == [6 + n for n in range(len(rounds))]
    assert len(rounds) > 2
    estimates = np.array([r["largest_estimate"] for r in rounds])
    assert estimates[-1] <= 5e-6 < estimates[-2]
    assert certificate["reduction"]["method"] == "reduced_basis"
    assert certificate["displacement"]["relative_l2"] < 2e-5


def test_methods_reduce_the_same_solutions(tmp_path) -> None:
    errors = {}
    for method in ("galerkin", "pod", "sparse_pgd"):
        sampling = {"scheme": "sobol", "training": 16, "held_out": 6, "refined": 0}
        study = BLOCK | {"sampling": sampling, "reduction": {"method": method, "max_degree": 4}}
        model = build(make_study(study), tmp_path / "block.morph")
        assert model.certificate["reduction"]["method"] == method
        errors[method] = model.certificate["displacement"]["relative_l2"]
    assert len(list((tmp_path / "block.morph.snapshots").glob("*.npz"))) == 22
    assert max(errors["galerkin"], errors["pod"]) < 1e-3
    assert errors["sparse_pgd"] < 0.05


def lose_reduced_solutions(monkeypatch) -> None:
    """Let no reduced solution be found, as where the projected equations have a limit point that the full ones lack."""

    def stalled(equations, mu, start):
        raise SolverError("stalls")

    def lost(equations, start, target):
        raise PathError("stalls", [start])

    monkeypatch.setattr(galerkin.ReducedSolver, "_corrected", lambda *_: None)
    monkeypatch.setattr(galerkin, "solve", stalled)
    monkeypatch.setattr(galerkin, "advance", lost)


def test_a_default_method_without_reduced_solutions_gives_way_to_pod(tmp_path, monkeypatch) -> None:
    lose_reduced_solutions(monkeypatch)
    solver = {"threads": 1, "workers": 1}
    study = BLOCK | {"solver": solver, "sampling": {"scheme": "sobol", "training": 12, "held_out": 4, "refined": 0}}
    build(make_study(study | {"reduction": {}}), tmp_path / "block.morph")
    model = load_model(tmp_path / "block.morph")
    reduction = model.certificate["reduction"]
    assert reduction["method"] == "pod"
    (warning,) = reduction["warnings"]
    place = r"bend = [-\d.]+ deg, squash = [-\d.]+ mm"
    assert re.search(rf'"galerkin" failed, "pod" .* solved at {place}, nor beyond {place}', warning)
    assert warning in build_warnings(model.certificate)
    # The face that is led: turned by 20 degrees about y through its middle at z = 60 mm, and pushed in by 2 mm.
    end, turn = model.nodes[:, 2] > 0.06 - 1e-9, np.radians(20.0)
    x, y, _ = model.nodes[end].T
    led = np.column_stack([0.01 + np.cos(turn) * (x - 0.01), y, 0.058 - np.sin(turn) * (x - 0.01)])
    moved = model.nodes[end] + model.at({"bend": "20 deg", "squash": "2 mm"}).displacement()[end]
    assert np.abs(moved - led).max() < 1e-4
    with pytest.raises(StudyError, match=r'"galerkin" failed: .* Use reduction\.method = "pod"'):
        build(make_study(study | {"reduction": {"method": "galerkin"}}), tmp_path / "block.morph")


def test_what_takes_the_place_of_a_method_has_all_samples_that_the_study_allows(tmp_path, monkeypatch) -> None:
    """Adaptive sampling ends with the first six, of which regression alone makes a poor model."""
    lose_reduced_solutions(monkeypatch)
    monkeypatch.setattr(solutions, "sample_adaptively", lambda study, *_: (training_samples(study), []))
    sampling = {"first": 6, "training": 12, "held_out": 4, "refined": 0}
    study = BLOCK | {"solver": {"threads": 1, "workers": 1}, "sampling": sampling, "reduction": {}}
    model = build(make_study(study), tmp_path / "block.morph")
    assert model.certificate["reduction"]["method"] == "pod"
    assert model.certificate["samples"]["training"] == 12


def test_a_build_reduces_in_its_own_threads_where_all_samples_are_found(tmp_path) -> None:
    solver = {"threads": 1, "workers": 1}
    sampling = {"scheme": "sobol", "training": 8, "held_out": 4, "refined": 0}
    study = BLOCK | {"solver": solver, "sampling": sampling, "reduction": {"method": "pod"}}
    build(make_study(study), tmp_path / "block.morph")
    try:
        ngsolve.SetNumThreads(2)
        build(make_study(study), tmp_path / "block.morph")
        with ngsolve.TaskManager():
            assert ngsolve.GetNumThreads() == 1
    finally:
        ngsolve.SetNumThreads(1)


@pytest.mark.slow
def test_reactions_of_a_model_balance_its_loads(tmp_path) -> None:
    study = tomllib.loads(STUDY) | {"reduction": {"method": "galerkin"}}
    model, area = build(make_study(study), tmp_path / "block.morph"), 0.02**2
    force = model.at({"pull": 4e5, "push": 2e4, "young": 3e6}).reactions()["force_z_min"]
    assert force == pytest.approx([-2e4 * area, 0.0, -4e5 * area], abs=2e-3 * 4e5 * area)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('method = "krylov"', ["reduction.method"]),
        ('method = "pgd"', ["reduction.method", "galerkin, pod, reduced_basis, sparse_pgd"]),
        ('basis = "kriging"', ["reduction.basis", '"chebyshev", "cubic_spline"']),
        ('method = "sparse_pgd"\nformat = "tucker"', ["reduction.format", '"cp"']),
        ('method = "galerkin"\nformat = "polynomial"\nbasis = "hat"', ["reduction.basis"]),
        ('method = "pod"\n[sampling]\nscheme = "adaptive"', ["sampling.scheme", '"galerkin"']),
    ],
)
def test_a_wrong_choice_is_one_message(tmp_path, refused, line, words):
    path = write_study(
        tmp_path, ("[sampling]\ntraining = 24\nheld_out = 6\nrefined = 0\n", ""), ('method = "pod"', line)
    )
    path.write_text(path.read_text().replace("max_degree = 2\n", ""))
    printed = refused("build", path, "-o", tmp_path / "x.morph")
    for word in words:
        assert word in printed


def test_methods_that_do_not_suit_a_study_are_refused_with_those_that_do():
    external = {
        "name": "runs",
        "external": {"table": "t.csv", "length_unit": "mm"},
        "reduction": {"method": "galerkin"},
    }
    with pytest.raises(StudyError, match='"galerkin"'):
        resolve_defaults(make_study(external))


def test_defaults_follow_the_study():
    content = tomllib.loads(STUDY) | {"reduction": {}, "sampling": {}}
    several = resolve_defaults(make_study(content))
    assert (several.reduction.method, several.sampling.scheme) == ("galerkin", "adaptive")
    one = json.loads(json.dumps(BLOCK)) | {"parameters": {"bend": BLOCK["parameters"]["bend"]}, "reduction": {}}
    del one["supports"][1]["translation"]
    single = resolve_defaults(make_study(one))
    assert (single.reduction.method, single.sampling.scheme) == ("pod", "adaptive")
