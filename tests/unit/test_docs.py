"""The programs in the documentation do what it says."""

import re
from pathlib import Path

import numpy as np

from morph_dslam.model import load_model, save_model
from tests.support.bent_sheet import bent_sheet_model

DOCS = Path(__file__).parents[2] / "docs"


def test_the_model_file_can_be_read_with_the_documented_program(tmp_path):
    (program,) = re.findall(r"```python\n(.*?)```", (DOCS / "model-file.md").read_text(), flags=re.DOTALL)
    assert "morph_dslam" not in program
    names = {}
    exec(program, names)
    path, mu = tmp_path / "sheet.morph", np.array([0.025, -0.3, 0.2])
    model = bent_sheet_model(9, 7)
    save_model(path, model)
    positions = names["deformed_positions"](path, mu)
    np.testing.assert_allclose(positions, model.positions(mu), atol=1e-8)
    np.testing.assert_allclose(positions, load_model(path).positions(mu), atol=1e-12)


def test_links_between_documents_lead_somewhere():
    for page in [*DOCS.glob("*.md"), DOCS.parent / "README.md", DOCS.parent / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\(([\w./-]+\.\w+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
