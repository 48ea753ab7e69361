"""One-page reports: HTML with its pictures inside, readable in any browser and without any other file."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1f24; max-width: 62rem; }
body { margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #d0d7de; }
table { border-collapse: collapse; margin: 1rem 0; }
td, th { padding: .25rem .9rem .25rem 0; text-align: left; }
td { font-variant-numeric: tabular-nums; } th { white-space: nowrap; }
tr { border-bottom: 1px solid #eaeef2; }
figure { margin: 1rem 0; } img { max-width: 100%; } figcaption { color: #57606a; font-size: .9rem; }
.warning { background: #fff8c5; border-left: 4px solid #d4a72c; padding: .5rem 1rem; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(12rem, 1fr)); gap: .8rem; }
.figures div { border: 1px solid #d0d7de; border-radius: 6px; padding: .6rem .9rem; }
.figures b { display: block; font-size: 1.3rem; font-weight: 600; } .figures span { color: #57606a; }
.wide { overflow-x: auto; } .wide table { margin: .3rem 0 .6rem; }
summary { cursor: pointer; color: #57606a; }
pre { background: #f6f8fa; padding: .8rem 1rem; font-size: .85rem; overflow-x: auto; }
</style>
</head>
<body>
<h1>$title</h1>
$body
</body>
</html>
""")
_MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml"}


@dataclass(frozen=True)
class Text:
    """A paragraph; ``warning`` makes it stand out."""

    text: str
    warning: bool = False

    def html(self) -> str:
        return f'<p class="warning">{escape(self.text)}</p>' if self.warning else f"<p>{escape(self.text)}</p>"


@dataclass(frozen=True)
class Table:
    """Rows of texts under an optional header."""

    rows: Sequence[Sequence[str]]
    header: Sequence[str] = ()

    @classmethod
    def of(cls, figures: Mapping[str, str]) -> Table:
        """Two columns, a name and its value."""
        return cls(list(figures.items()))

    def text(self) -> list[str]:
        """The table in lines, columns aligned on their left."""
        rows = [self.header, *self.rows] if self.header else self.rows
        widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
        return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]

    def html(self) -> str:
        lines = [_row(self.header, "th")] if self.header else []
        lines += [_row(row, "td") for row in self.rows]
        return '<div class="wide"><table>\n' + "\n".join(lines) + "\n</table></div>"


@dataclass(frozen=True)
class KeyFigures:
    """The few figures that are looked for first, each a name and its value."""

    figures: Mapping[str, str]

    def html(self) -> str:
        cards = [
            f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in self.figures.items()
        ]
        return '<div class="figures">\n' + "\n".join(cards) + "\n</div>"


@dataclass(frozen=True)
class Listing:
    """A text as it stands, folded away under ``title``."""

    title: str
    text: str

    def html(self) -> str:
        return f"<details><summary>{escape(self.title)}</summary><pre>{escape(self.text)}</pre></details>"


@dataclass(frozen=True)
class Picture:
    """An encoded image, ``suffix`` .png, .jpg or .svg, shown inside the page."""

    data: bytes
    suffix: str
    caption: str

    @classmethod
    def read(cls, path: Path, caption: str) -> Picture:
        return cls(path.read_bytes(), path.suffix, caption)

    def html(self) -> str:
        text, encoded = escape(self.caption), base64.b64encode(self.data).decode()
        source = f"data:{_MEDIA_TYPES[self.suffix]};base64,{encoded}"
        return f'<figure><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>'


@dataclass(frozen=True)
class Link:
    """A link to a file beside the page."""

    target: str
    text: str

    def html(self) -> str:
        return f'<p><a href="{escape(self.target)}">{escape(self.text)}</a></p>'


Block = Text | Table | KeyFigures | Listing | Picture | Link


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it."""

    heading: str
    blocks: Sequence[Block]

    def html(self) -> str:
        return "\n".join([f"<h2>{escape(self.heading)}</h2>", *(block.html() for block in self.blocks)])


def _row(cells: Sequence[str], tag: str) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def write_report(path: str | Path, title: str, sections: Sequence[Section]) -> None:
    """Write a self-contained HTML page; sections without blocks are left out."""
    path = Path(path)
    body = "\n".join(section.html() for section in sections if section.blocks)
    path.write_text(_PAGE.substitute(title=escape(title), body=body), encoding="utf-8")
