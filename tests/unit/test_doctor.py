"""`morph doctor`: it says what is there, and that the chain from study to tracked block works."""

import re
from importlib.metadata import version

from morph_dslam.cli import app as cli


def test_the_self_test_tracks_a_block(capsys):
    assert cli.main(["doctor"]) == 0
    printed = capsys.readouterr().out
    assert re.search(rf"^numpy +{re.escape(version('numpy'))}$", printed, re.MULTILINE)
    found = re.search(
        r"^self-test +a block built, filmed and tracked .* ([\d.]+) mm off at most$", printed, re.MULTILINE
    )
    assert found
    assert float(found[1]) < 0.2


def test_what_is_missing_is_named_and_mended(monkeypatch, capsys):
    monkeypatch.setattr("morph_dslam.cli.doctor.PACKAGES", ("numpy", "not-there"))
    assert cli.main(["doctor", "--quick"]) == 2
    printed = capsys.readouterr()
    assert re.search(r"^not-there +FAILED: not installed; run", printed.out, re.MULTILINE)
    assert "failed: not-there" in printed.err
    assert "self-test" not in printed.out
