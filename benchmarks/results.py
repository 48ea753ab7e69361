"""Run benchmarks and examples, keep what they print last, and write the page of results from it.

    python benchmarks/results.py run NAME...     # run these, and keep their last lines in benchmarks/results
    python benchmarks/results.py keep NAME LOG   # the same from the output of a run, kept in a file
    python benchmarks/results.py page            # write docs/results.md and the table in README.md

Each figure of that page is what a command has printed, with its date.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from datetime import date, datetime
from pathlib import Path

from recorded import BENCHMARKS, SHOWN, Benchmark

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "benchmarks" / "results"
BEGIN, END = "<!-- results: written by benchmarks/results.py -->", "<!-- end of results -->"

INTRODUCTION = """\
# Results

The command beside each figure printed it. `python benchmarks/results.py` runs the commands and writes this page. Errors
are distances of material points in the camera frame, without alignment, unless stated otherwise. Times are those of a
shared machine and vary between runs. *Truth* is what the result was compared with, *noise* what the images contain.

A simulated recording measures the error of images, map and estimation. It does not contain the error of a model of a
real object: wrong material constants, supports or dimensions. Only results whose truth is *measured* do.
"""


def machine() -> str:
    """This machine in words."""
    cores = len(os.sched_getaffinity(0))
    return f"{cores} core{'s' * (cores > 1)} of a shared {platform.machine()} machine, no GPU"


def commit() -> str:
    """The present commit, as git abbreviates it."""
    command = ["git", "rev-parse", "--short=7", "HEAD"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def keep(name: str, output: str, day: str, of_commit: str) -> None:
    """Keep the last lines of an output, without what says how far it is and lines that only name a file."""
    lines = [line.rpartition("\r")[2].rstrip() for line in output.split("\n")]
    lines = [line for line in lines if line and not re.search(r"\d+%\||^\w+ +/\S+$|\.\.\.$", line)]
    kept = [re.sub(r"/\S*/(?=(?:examples|benchmarks|demo)/)", "", line) for line in lines[-BENCHMARKS[name].lines :]]
    content = {"date": day, "commit": of_commit, "command": BENCHMARKS[name].command, "machine": machine()}
    KEPT.mkdir(exist_ok=True)
    (KEPT / f"{name}.json").write_text(json.dumps(content | {"output": kept}, indent=2) + "\n")


def run(names: list[str], data: Path | None) -> int:
    """Run benchmarks one after the other and keep what they print; the number that failed."""
    failed = 0
    for name in names:
        words = [sys.executable if word == "python" else word for word in shlex.split(BENCHMARKS[name].command)]
        if words[-1] == "DIR":
            words[-2:] = ["--data", str(data)] if data is not None else []
        print(f"== {name}: {shlex.join(words)}", flush=True)
        done = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        print(done.stdout)
        if done.returncode:
            failed += 1
        else:
            keep(name, done.stdout, date.today().isoformat(), commit())
    return failed


def kept() -> dict[str, dict]:
    """What was kept, by name, in the order of the page."""
    return {name: json.loads(path.read_text()) for name in BENCHMARKS if (path := KEPT / f"{name}.json").exists()}


def page() -> str:
    """The page of results."""
    found = kept()
    parts = [INTRODUCTION]
    for section in dict.fromkeys(benchmark.section for benchmark in BENCHMARKS.values()):
        names = [name for name in found if BENCHMARKS[name].section == section]
        if names:
            parts.append(f"## {section}\n")
            parts += [_entry(BENCHMARKS[name], found[name]) for name in names]
    missing = [b for name, b in BENCHMARKS.items() if name not in found]
    if missing:
        parts.append("## Not run for this version\n")
        parts.append("\n".join(f"- {b.title}: `{b.command}`" for b in missing) + "\n")
    return "\n".join(parts)


def _entry(benchmark: Benchmark, content: dict) -> str:
    rows = [
        ("command", f"`{content['command']}`"),
        ("date", f"{content['date']}, commit {content['commit']}"),
        ("machine", content["machine"]),
    ]
    rows += [("truth", benchmark.truth)] + [("noise", benchmark.noise)] * bool(benchmark.noise)
    table = "\n".join(["| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in rows)])
    about = f"{benchmark.about}\n\n" if benchmark.about else ""
    output = "\n".join(content["output"])
    return f"### {benchmark.title}\n\n{about}{table}\n\n```text\n{output}\n```\n"


def readme_table() -> str:
    """The table in README.md."""
    rows = ["| | mean error | 95 % | frames tracked | truth |", "|---|---|---|---|---|"]
    for name, content in kept().items():
        if name in SHOWN:
            figures = dict(re.findall(r"(\w+)=(\S+)", content["output"][-1]))
            mean, largest, tracked = (figures[key] for key in SHOWN[name])
            kind = BENCHMARKS[name].truth.split(":")[0]
            tracked = tracked.replace("/", " of ")
            rows.append(f"| {BENCHMARKS[name].title} | {mean} mm | {largest} mm | {tracked} | {kind} |")
    return "\n".join(rows)


def write_pages() -> None:
    """Write docs/results.md, and the table between its marks in README.md."""
    (ROOT / "docs" / "results.md").write_text(page())
    path = ROOT / "README.md"
    text = path.read_text()
    start, stop = text.index(BEGIN) + len(BEGIN), text.index(END)
    path.write_text(f"{text[:start]}\n\n{readme_table()}\n\n{text[stop:]}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    running = commands.add_parser("run", help="run benchmarks and keep their last lines")
    running.add_argument("names", nargs="+", choices=BENCHMARKS, metavar="NAME")
    running.add_argument("--data", type=Path, help="folder of recordings that must be obtained separately")
    keeping = commands.add_parser("keep", help="keep the last lines of an output that is in a file")
    keeping.add_argument("name", choices=BENCHMARKS, metavar="NAME")
    keeping.add_argument("log", type=Path)
    keeping.add_argument("--commit", help="that was run (the present one)")
    commands.add_parser("page", help="write docs/results.md and the table in README.md")
    arguments = parser.parse_args()
    if arguments.command == "run":
        return run(arguments.names, arguments.data)
    if arguments.command == "keep":
        day = datetime.fromtimestamp(arguments.log.stat().st_mtime).date().isoformat()
        keep(arguments.name, arguments.log.read_text(), day, arguments.commit or commit())
    else:
        write_pages()
    return 0


if __name__ == "__main__":
    sys.exit(main())
