"""Text files are UTF-8, whatever the locale of the computer says."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import morph_dslam

SOURCES = Path(morph_dslam.__file__).parent
#: Modules and objects whose `open` is of no text file.
OTHER_OPEN = {"os", "webbrowser", "Image", "kind"}
#: Methods of paths, with the place of the encoding among their arguments.
TEXT_METHODS = {"read_text": 0, "write_text": 1}


def without_encoding(tree: ast.AST) -> Iterator[int]:
    """Lines that open text in the encoding of the locale."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or any(word.arg == "encoding" for word in node.keywords):
            continue
        function = node.func
        if isinstance(function, ast.Attribute) and function.attr in TEXT_METHODS:
            if len(node.args) <= TEXT_METHODS[function.attr]:
                yield node.lineno
        elif opens_text(node):
            yield node.lineno


def opens_text(call: ast.Call) -> bool:
    """Whether a call is open(...) or path.open(...) of a text file."""
    function = call.func
    if isinstance(function, ast.Name) and function.id == "open":
        given = call.args[1:2]
    elif isinstance(function, ast.Attribute) and function.attr == "open":
        if isinstance(function.value, ast.Name) and function.value.id in OTHER_OPEN:
            return False
        given = call.args[:1]
    else:
        return False
    given += [word.value for word in call.keywords if word.arg == "mode"]
    modes = [one.value for one in given if isinstance(one, ast.Constant)]
    return not given or bool(modes and "b" not in str(modes[0]))


def test_no_text_file_is_opened_in_the_encoding_of_the_locale() -> None:
    assert list(without_encoding(ast.parse('p.open("w")\nopen(p)\np.read_text()\np.write_text(t)\np.open("rb")'))) == [
        1, 2, 3, 4,
    ]  # fmt: skip
    found = {
        f"{path.relative_to(SOURCES)}:{line}"
        for path in sorted(SOURCES.rglob("*.py"))
        for line in without_encoding(ast.parse(path.read_text(encoding="utf-8")))
    }
    assert not found
