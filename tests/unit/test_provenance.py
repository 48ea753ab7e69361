"""Where a model comes from: the mesh by its hash, the programs by their versions; the keys of its study."""

import hashlib
import json
import platform
import re
import runpy
import tomllib
from dataclasses import replace
from importlib.metadata import version

import numpy as np

from morph_dslam import make_study
from morph_dslam.studies.provenance import mesh_hash, provenance
from tests.support.bent_sheet import bent_sheet_model
from tests.support.block_study import STUDY
from tests.support.documents import PROJECT
from tests.support.stretched_block import stretched_block_model


def test_the_mesh_hash_is_that_of_its_arrays():
    model = bent_sheet_model(3, 3)
    expected = hashlib.sha256(model.nodes.astype("<f8").tobytes() + model.triangles.astype("<i8").tobytes())
    assert mesh_hash(model) == expected.hexdigest()


def test_any_other_mesh_has_another_hash():
    model = stretched_block_model()
    moved, turned = model.nodes.copy(), {"hex8": model.cells["hex8"][::-1].copy()}
    moved[3, 1] = np.nextafter(moved[3, 1], 1.0)
    others = [replace(model, nodes=moved), replace(model, cells=turned), replace(model, cells={})]
    assert len({mesh_hash(each) for each in [model, *others]}) == 4


def test_versions_and_linear_solver(monkeypatch):
    monkeypatch.setenv("MORPH_LINEAR_SOLVER", "sparsecholesky")
    facts = provenance("name = 'x'", make_study(tomllib.loads(STUDY)), bent_sheet_model(3, 3))
    assert facts["study"] == "name = 'x'"
    assert facts["linear_solver"] == "sparsecholesky"
    assert facts["versions"]["numpy"] == version("numpy")
    assert facts["versions"]["python"] == platform.python_version()
    json.dumps(facts)
    assert "time_parameter" not in facts


def test_the_parameter_of_time_is_known_among_others_that_measure_time():
    content = tomllib.loads(STUDY)
    material = next(iter(content["materials"].values()))
    material["prony"] = {"relative_moduli": [0.3], "times": ["tau"]}
    content["parameters"] |= {"tau": {"range": ["1 s", "8 s"]}, "held": {"range": ["0 s", "20 s"]}}
    content["time"] = {"parameter": "held", "step": "1 s"}
    study = make_study(content)
    model = replace(bent_sheet_model(3, 3), parameters=tuple(study.model_parameters()))
    assert [model.parameters[k].name for k in model.clocks] == ["tau", "held"]
    known = replace(model, provenance=provenance("", study, model))
    assert [known.parameters[k].name for k in known.clocks] == ["held"]


def test_every_key_stands_in_the_reference():
    page = runpy.run_path(str(PROJECT / "docs" / "study_keys.py"))["study_reference"]()
    for text in (
        "[sampling]",
        "[parameters.NAME]",
        "[[loads]] kind = gravity",
        "[mesh] generator = block",
        "[external]",
    ):
        assert f"`{text}`" in page
    assert "| `held_out` | whole number | `59` |" in page
    assert "| `thickness` | length |" in page
    assert page.count("| key | value | default |") > 25
    for text in ("[[mesh.collars]]", "[[mesh.holes]]"):  # sections in a section
        assert page.count(f"`{text}`") == 1
    assert re.findall(r"\b_[A-Z]\w+|``|6\.28\S*|NoneType", page) == []
    assert "| `angles` | [angle, angle] | `[0.0, 2 pi]` |" in page
    assert '| `description` | text | `""` |' in page


def test_the_reference_of_shells_has_no_key_that_they_refuse():
    page = runpy.run_path(str(PROJECT / "docs" / "study_keys.py"))["study_reference"]()
    solids, shells, _, _ = page.split("\n## ")
    assert "| `first` | true or false |" in solids
    assert "| `first` | true or false |" not in shells
    assert "| `first` | whole number |" in shells  # of [sampling]
