"""The documentation as tests read it: its pages, their samples, and the words that they show as code."""

import argparse
import re
from pathlib import Path

from morph_dslam.cli.app import new_parser

PROJECT = Path(__file__).parents[2]
_FILES = [*(PROJECT / "docs").rglob("*.md"), PROJECT / "README.md"]
#: By name, with the folder of those that are in one: `cameras`, `how/camera`.
PAGES = {str(path.relative_to(PROJECT).with_suffix("")).removeprefix("docs/"): path.read_text() for path in _FILES}


def samples(page: str, language: str) -> list[str]:
    """The fenced blocks of one language in a page."""
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGES[page], flags=re.DOTALL | re.MULTILINE)


def code_words(page: str) -> set[str]:
    """Words that a page shows as code, in a line or in a block."""
    blocks = re.findall(r"^```.*?^```$", PAGES[page], flags=re.DOTALL | re.MULTILINE)
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", PAGES[page], flags=re.DOTALL | re.MULTILINE))
    return set(re.findall(r"\w+", " ".join([*blocks, *spans])))


def commands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each command."""
    (action,) = (a for a in new_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return dict(action.choices)


def options(parser: argparse.ArgumentParser) -> set[str]:
    """What a command takes, "--output" say."""
    return {text for action in parser._actions for text in action.option_strings if text.startswith("--")}
