"""Reports: what is inside, escaped and embedded."""

import base64
from html.parser import HTMLParser

from morph_dslam.evaluation.model_summary import flatten
from morph_dslam.evaluation.report import Link, Picture, Section, Table, Text, write_report


class Reader(HTMLParser):
    """Collects cells, headings and picture sources, and checks that tags are closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.texts, self.sources = [], {}, []

    def handle_starttag(self, tag, attributes):
        if tag == "img":
            self.sources.append(dict(attributes)["src"])
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and data.strip():
            self.texts.setdefault(self.open[-1], []).append(data)


def test_a_report_holds_its_sections_and_pictures(tmp_path):
    picture = b"\x89PNG not really"
    (tmp_path / "plot.png").write_bytes(picture)
    sections = [
        Section("Figures & <facts>", [Table.of({"a < b": "1.0 mm"}), Text("Careful!", warning=True)]),
        Section("Pictures", [Picture.read(tmp_path / "plot.png", "A plot"), Link("video.mp4", "The video")]),
        Section("Nothing here", []),
        Section("Wide", [Table([["1", "2", "3"]], ("x", "y", "z"))]),
    ]
    write_report(tmp_path / "report.html", "A $5 title", sections)
    reader = Reader()
    reader.feed((tmp_path / "report.html").read_text())
    assert reader.open == []
    assert reader.texts["h1"] == ["A $5 title"]
    assert reader.texts["h2"] == ["Figures & <facts>", "Pictures", "Wide"]
    assert reader.texts["td"] == ["a < b", "1.0 mm", "1", "2", "3"]
    assert reader.texts["th"] == ["x", "y", "z"]
    assert [base64.b64decode(source.split(",")[1]) for source in reader.sources] == [picture]


def test_certificates_are_flattened_with_their_units():
    facts = flatten(
        {
            "displacement": {"mean_mm": 0.0123456, "n_held_out": 40},
            "compression_percent": 99.5,
            "orders": [1.5, 2],
            "failed": [],
            "notes": [{"a": 1}, {"a": 2}],
            "study": "line one\nline two",
        }
    )
    assert facts == {
        "displacement: mean": "0.01235 mm",
        "displacement: n held out": "40",
        "compression": "99.5 %",
        "orders": "1.5, 2",
        "failed": "none",
        "notes": "2 entries",
    }
