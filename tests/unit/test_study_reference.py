"""The reference of study files names every section and key that the models read."""

from morph_dslam.studies.reference import study_reference


def test_every_key_stands_in_the_reference():
    page = study_reference()
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
