"""The build's report in a real browser: every picture shows, nothing is fetched, nothing sticks out."""

import pytest

from morph_dslam.reduction.report import write_build_report
from tests.support.certified_block import certified_block_model
from tests.support.chromium import Page, find_chromium

pytestmark = pytest.mark.skipif(find_chromium() is None, reason="no Chromium on this machine")


def test_the_report_shows_in_a_browser(tmp_path):
    path = tmp_path / "block.report.html"
    write_build_report(path, certified_block_model())
    with Page(tmp_path / "profile") as page:
        page.send("Page.navigate", url=path.as_uri())
        page.wait_for("document.title.startsWith('stretched block') && document.readyState === 'complete'")
        widths = page.evaluate("[...document.images].map(image => image.complete ? image.naturalWidth : 0)")
        assert len(widths) == 4
        assert min(widths) > 600
        for width in (1000, 480):
            metrics = {"height": 700, "deviceScaleFactor": 1, "mobile": False}
            page.send("Emulation.setDeviceMetricsOverride", width=width, **metrics)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.problems == []
        assert [url for url in page.requests if not url.startswith("data:")] == [path.as_uri()]
