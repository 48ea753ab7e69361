"""What the site takes from the program: the command line, the public names, equations, and a notebook.

MkDocs calls the functions whose names begin with ``on_``; `mkdocs.yml` names this file.
"""

from __future__ import annotations

import argparse
import html
import importlib
import json
import re
import runpy
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File

PROJECT = Path(__file__).parents[1]
#: Notebooks among the tutorials, whose pages are made from their source.
NOTEBOOKS = sorted(path.stem for path in (PROJECT / "docs/tutorials").glob("*.py"))

#: Public names by subject; names in no group come last.
GROUPS = {
    "Models": ["build", "load_study", "make_study", "load_model", "save_model", "ReducedModel", "Parameter"],
    "Models in other programs": ["export", "StateChoice", "explore"],
    "Mechanics": ["SolidProblem", "write_build_report"],
    "Cameras, frames and scenes": [
        *("Camera", "load_camera", "calibrate", "Board", "open_source", "open_live", "Frame"),
        *("map_scene", "SlamOptions", "Scene", "load_scene"),
    ],
    "Registration": [*("register", "register_landmarks", "register_board", "load_registration", "Registration")],
    "Tracking": [
        *("Tracker", "TrackerOptions", "FrameResult", "Status", "TrackingWarning"),
        *("Session", "track", "TrackOptions"),
    ],
    "Simulation and evaluation": [
        *("simulate", "SimulatedSequence", "Run", "load_run"),
        *("evaluate", "evaluate_depth", "evaluate_trajectory"),
    ],
    "Errors": ["MorphError"],
}

API_INTRODUCTION = """\
# Python API

All public names of `import morph_dslam as md`. They keep their meaning within a major version.
[Building blocks](extend.md) are what they are made of. Lengths are in metres, stresses in pascals, angles in radians;
pixel (0, 0) is the centre of the first pixel.
"""
EXTEND_INTRODUCTION = """\
# Building blocks: `morph_dslam.extend`

For those who extend the program or build experiments of their own. These names may change in a minor version; the
[changelog](../changelog.md) says how.
"""
COMMANDS_INTRODUCTION = """\
# Command line

`morph COMMAND --help` prints the same. A mistake in the input ends with one message and exit status 2, Ctrl-C with 130.
Nothing prompts, and nothing needs a display.
"""

STUDY_KEYS_INTRODUCTION = """\
# Study keys

All keys with their defaults. The pages on the study of a [solid](../solid-study.md), a [shell](../shell-study.md) and a
[sheet](../study-file.md) explain them.

"""

#: What the pages have documented so far: public names, and what pages of "How it works" refer to.
_documented: set[str] = set()


def on_pre_build(config):
    _documented.clear()
    _documented.update(_canonical(name) for name in public_names())


def on_files(files, config):
    pages = {
        "reference/api.md": api_page(),
        "reference/extend.md": extend_page(),
        "reference/commands.md": commands_page(),
        "reference/study-keys.md": study_keys_page(),
        "changelog.md": _from_root("CHANGELOG.md"),
        "contributing.md": _from_root("CONTRIBUTING.md"),
    }
    for stem in NOTEBOOKS:
        text = (PROJECT / f"docs/tutorials/{stem}.py").read_text()
        name = f"tutorials/{stem}"
        link = f"[Download as a notebook]({stem}.ipynb)"
        pages[f"{name}.md"] = notebook_page(text).replace("\n\n", f"\n\n{link}\n\n", 1)
        files.append(File.generated(config, f"{name}.ipynb", content=json.dumps(notebook(text))))
    for path, content in pages.items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown, page, config, files):
    """Links to notebooks lead to their pages; "How it works" ends with the functions that no other page has."""
    markdown = re.sub(rf"\]\(((?:[\w./-]*/)?(?:{'|'.join(NOTEBOOKS)}))\.py\)", r"](\1.md)", markdown)
    if not page.file.src_uri.startswith("how/"):
        return markdown
    names = dict.fromkeys(re.findall(r"\]\[(morph_dslam\.[\w.]+)\]", markdown))
    blocks = []
    for name in names:
        canonical = _canonical(name)
        if not any(canonical == other or canonical.startswith(f"{other}.") for other in _documented):
            _documented.add(canonical)
            blocks.append(f"::: {name}\n    options:\n      show_source: true\n      show_root_full_path: true\n")
    return "\n".join([markdown, "\n## In the source\n\n" if blocks else "", *blocks])


def on_page_content(content, page, config, files):
    """Equations become MathML, which browsers draw by themselves."""
    inline = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
    content = inline.sub(lambda found: convert(html.unescape(found[1])), content)
    block = re.compile(r'<div class="arithmatex">\\\[(.*?)\\\]</div>', re.DOTALL)
    return block.sub(lambda found: convert(html.unescape(found[1]), display="block"), content)


def public_names() -> list[str]:
    """Dotted names of all that is public: `morph_dslam` and `morph_dslam.extend` with its modules."""
    return [f"{module}.{name}" for module in _modules() for name in names_of(module)]


def names_of(module: str) -> list[str]:
    """The public names of a module: those that it lists, or all that it imports."""
    found = importlib.import_module(module)
    return getattr(found, "__all__", None) or sorted(name for name in vars(found) if not name.startswith("_"))


def _modules() -> list[str]:
    inner = sorted(path.stem for path in (PROJECT / "src/morph_dslam/extend").glob("[!_]*.py"))
    return ["morph_dslam", "morph_dslam.extend", *(f"morph_dslam.extend.{name}" for name in inner)]


def resolve(dotted: str) -> object:
    """The object of a dotted name; an `AttributeError` or `ModuleNotFoundError` if there is none."""
    module, attributes = dotted, []
    while True:
        try:
            found = importlib.import_module(module)
            break
        except ModuleNotFoundError:
            module, _, last = module.rpartition(".")
            attributes.insert(0, last)
            if not module:
                raise
    for name in attributes:
        fields = getattr(found, "__dataclass_fields__", {})
        found = fields[name] if name in fields else getattr(found, name)
    return found


def _canonical(dotted: str) -> str:
    """Where an object is defined, or the name itself where that is not known."""
    try:
        found = resolve(dotted)
    except (AttributeError, ModuleNotFoundError):
        return dotted  # mkdocstrings says that it is missing
    module, name = getattr(found, "__module__", None), getattr(found, "__qualname__", None)
    return f"{module}.{name}" if module and name and module.startswith("morph_dslam") else dotted


def api_page() -> str:
    """`morph_dslam.__all__` by subject."""
    names = names_of("morph_dslam")
    groups = {heading: [name for name in group if name in names] for heading, group in GROUPS.items()}
    grouped = {name for group in GROUPS.values() for name in group}
    groups["More"] = [name for name in names if name not in grouped]
    parts = [API_INTRODUCTION]
    for heading, group in groups.items():
        if group:
            parts += [f"## {heading}\n", *(f"::: morph_dslam.{name}\n" for name in group)]
    return "\n".join(parts)


def extend_page() -> str:
    """`morph_dslam.extend` and its modules."""
    parts = [EXTEND_INTRODUCTION]
    known = {_canonical(f"morph_dslam.{name}") for name in names_of("morph_dslam")}
    for module in _modules()[1:]:
        found = importlib.import_module(module)
        parts += [f"## `{module.removeprefix('morph_dslam.')}`\n", f"{(found.__doc__ or '').strip().splitlines()[0]}\n"]
        for name in names_of(module):
            canonical = _canonical(f"{module}.{name}")
            if canonical not in known and canonical.startswith("morph_dslam."):
                known.add(canonical)
                parts.append(f"::: {module}.{name}\n")
    return "\n".join(parts)


def subcommands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each command."""
    parser = importlib.import_module("morph_dslam.cli.app").new_parser()
    (action,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return dict(action.choices)


def commands_page() -> str:
    """Each command with a table of its arguments, as `morph COMMAND --help` has them."""
    parts = [COMMANDS_INTRODUCTION]
    for name, parser in subcommands().items():
        parts.append(f"## morph {name}\n\n{parser.description}\n")
        exclusive = [{id(a) for a in group._group_actions} for group in parser._mutually_exclusive_groups]
        rows = ["| argument | meaning |", "|---|---|"]
        for action in parser._actions:
            if not isinstance(action, argparse._HelpAction):
                one_of = any(id(action) in group for group in exclusive)
                rows.append(f"| {_spelling(action)} | {_meaning(action, one_of, parser.prog)} |")
        parts.append("\n".join(rows) + "\n")
    return "\n".join(parts)


def study_keys_page() -> str:
    """All keys of studies, from the models that read them."""
    return STUDY_KEYS_INTRODUCTION + runpy.run_path(str(PROJECT / "docs" / "study_keys.py"))["study_reference"]()


def _spelling(action: argparse.Action) -> str:
    name = action.metavar or (action.dest.upper() if action.option_strings else action.dest)
    if action.choices:
        name = " \\| ".join(f"`{choice}`" for choice in action.choices)
    value = "" if action.nargs == 0 else f" {name}"
    if not action.option_strings:
        return f"`{name}`"
    spellings = ", ".join(f"`{option}`" for option in action.option_strings)
    return spellings + (f" {name}" if action.choices else f" `{name}`" if value else "")


def _meaning(action: argparse.Action, one_of: bool, prog: str) -> str:
    text = (action.help or "") % {**vars(action), "prog": prog}
    text = re.sub(r"docs/([\w-]+)\.md", r"[\1](../\1.md)", text).replace("|", "\\|")
    notes = ["required"] * (action.required and bool(action.option_strings)) + ["one of several"] * one_of
    return text + (f" ({'; '.join(notes)})" if notes else "")


def _from_root(name: str) -> str:
    return re.sub(r"\]\(docs/", "](", (PROJECT / name).read_text())


def _cells(text: str) -> list[tuple[str, str]]:
    """Kind and text of each cell of a file in the percent format."""
    parts = re.split(r"^# %%(.*)\n", text, flags=re.MULTILINE)[1:]
    cells = []
    for mark, body in zip(parts[::2], parts[1::2], strict=True):
        if "[markdown]" in mark:
            cells.append(("markdown", re.sub(r"^# ?", "", body.strip(), flags=re.MULTILINE)))
        else:
            cells.append(("code", body.strip()))
    return cells


def notebook_page(text: str) -> str:
    """A notebook in the percent format as a page."""
    return "\n\n".join(body if kind == "markdown" else f"```python\n{body}\n```" for kind, body in _cells(text)) + "\n"


def notebook(text: str) -> dict:
    """A notebook in the percent format as Jupyter's own."""
    cells = []
    for kind, body in _cells(text):
        cell = {"cell_type": kind, "metadata": {}, "source": body.splitlines(keepends=True), "id": f"cell-{len(cells)}"}
        cells.append(cell | ({"outputs": [], "execution_count": None} if kind == "code" else {}))
    return {"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}
