"""Forms that change a study file, and study files that cannot be taken as they are."""

import json
import tomllib

import pytest

from morph_dslam.errors import StudioError
from morph_dslam.studio.study_file import changed_text, check_text, study_state

PLAIN = """# my study
name = "x"
[mesh]
file = "mesh.inp"
unit = "mm"

# the rubber
[materials.rubber]
law = "neo_hookean" # law remark
# young measured by Anna
young = "3 MPa"
poisson = 0.45

# held at the foot
[[supports]]
kind = "fixed"   # glued
on = "foot"

# pushed at the head
[[supports]]
kind = "displacement"
on = "head"
x = "push"

# the stroke
[parameters.push]
range = ["0 mm", "10 mm"]
description = "stroke of the machine"
"""
INLINE = """name = "x"
materials = {rubber = {law = "neo_hookean", young = "3 MPa", poisson = 0.45}} # as measured
supports = [{kind = "fixed", on = "foot"}, {kind = "fixed", on = "b"}]
parameters.push.range = ["0 mm", "1 mm"]
"""
SPLIT = """[materials.a]
law = "neo_hookean"
prony = {relative_moduli = [0.6], times = ["2 s"]}
[[supports]]
kind = "fixed"
on = "a"
[parameters.push]
range = [0, 1]
[materials.b]
law = "neo_hookean"
[[loads]]
kind = "pressure"
"""
CHANGES = [
    ("materials", "rubber", {"law": "yeoh", "bulk": "1 GPa", "prony": {"times": ["1 s"]}}),
    ("materials", "a", {"law": "neo_hookean", "prony": {"relative_moduli": [0.5], "times": ["2 s"]}}),
    ("materials", "b", None),
    ("materials", 'a b"c', {"law": "z"}),
    ("supports", 0, {"kind": "fixed"}),
    ("supports", 0, None),
    ("supports", 1, {"kind": "symmetry", "on": "foot"}),
    ("loads", 0, {"kind": "gravity", "acceleration": ["0", 0.5, "a"]}),
    ("loads", 0, None),
    ("parameters", "push", {"range": ["0 mm", "2 mm"], "default": 1}),
    ("parameters", "push", None),
    ("parameters", "new", {"range": [0, 2]}),
    ("contacts", 0, {"kind": "plane", "normal": [0, 0, 1]}),
    ("sampling", None, {"training": 9}),
    ("name", None, "other"),
]


def wanted(content, section, key, value):
    """The content of a study with one entry changed, None where there is nothing to take out."""
    before = content.get(section, {} if section in ("materials", "parameters") else [])
    if key is None:
        after = value
    elif isinstance(key, int):
        if key >= len(before) + (value is not None):
            return None
        after = [*before[:key], *([] if value is None else [value]), *before[key + 1 :]]
    else:
        after = {name: entry for name, entry in (before | {key: value}).items() if entry is not None}
    return {name: entry for name, entry in (content | {section: after}).items() if entry}


@pytest.mark.parametrize("text", [PLAIN, INLINE, SPLIT, 'name = "x"\n[materials]\n'])
@pytest.mark.parametrize("change", CHANGES)
def test_a_form_changes_one_entry_and_nothing_else(text, change):
    new = wanted(tomllib.loads(text), *change)
    if new is None:
        with pytest.raises(StudioError):
            changed_text(text, *change)
    else:
        assert {name: entry for name, entry in tomllib.loads(changed_text(text, *change)).items() if entry} == new


def test_remarks_and_order_stay():
    support = {"kind": "displacement", "on": "head", "x": "push"}
    assert changed_text(PLAIN, "supports", 1, support) == PLAIN
    new = PLAIN.replace('x = "push"\n', 'x = "push"\ny = "0 mm"\n')
    assert changed_text(PLAIN, "supports", 1, support | {"y": "0 mm"}) == new
    rubber = {"law": "neo_hookean", "young": "4 MPa", "poisson": 0.45}
    assert changed_text(PLAIN, "materials", "rubber", rubber) == PLAIN.replace("3 MPa", "4 MPa")
    push = {"range": ["0 mm", "12 mm"], "description": "stroke of the machine"}
    assert changed_text(PLAIN, "parameters", "push", push) == PLAIN.replace("10 mm", "12 mm")
    assert changed_text(INLINE, "supports", 1, {"kind": "fixed", "on": "c"}) == INLINE.replace('"b"', '"c"')
    assert "# as measured" in changed_text(INLINE, "materials", "rubber", rubber)


@pytest.mark.parametrize(
    ("text", "section", "key"),
    [
        ("materials = 3\n", "materials", "rubber"),
        ("[[materials]]\nlaw = 'x'\n", "materials", "rubber"),
        ("supports = 3\n", "supports", 0),
        ("[supports]\nkind = 'x'\n", "supports", 0),
    ],
)
def test_a_section_of_another_kind_is_changed_in_the_text_alone(text, section, key):
    for value in ({"kind": "fixed"}, None):
        with pytest.raises(StudioError, match="change the text"):
            changed_text(text, section, key, value)


@pytest.mark.parametrize("number", ["inf", "-inf", "nan"])
def test_numbers_that_are_not_finite_are_refused(number, tmp_path):
    text = f"{PLAIN}\n[parameters.p]\nrange = [0.0, {number}]\n"
    with pytest.raises(StudioError):
        check_text(text)
    (tmp_path / "study.toml").write_text(text)  # by hand
    state = study_state(tmp_path / "study.toml")
    assert json.loads(json.dumps(state, allow_nan=False))["text"] == text
    assert len(state["problems"]) == 1


def test_a_study_in_another_encoding_is_a_problem_and_is_shown(tmp_path):
    (tmp_path / "study.toml").write_bytes('# 5 µm\nname = "x"\n'.encode("latin-1"))
    state = study_state(tmp_path / "study.toml")
    assert state["text"] == '# 5 \ufffdm\nname = "x"\n'
    assert len(state["problems"]) == 1
    assert state["content"] is None
