"""The page of `morph explore` and the build's report in a real browser: what they say, and what they draw."""

import threading
from urllib.parse import urlsplit

import numpy as np
import pytest

from morph_dslam.explorer.server import make_server
from morph_dslam.reduction.report import write_build_report
from tests.support.bent_sheet import bent_sheet_model
from tests.support.certified_block import certified_block_model
from tests.support.chromium import Page, find_chromium
from tests.support.stretched_block import SHEAR_MODULUS, SIZE, YOUNG_MODULUS, stretched_block_model

pytestmark = pytest.mark.skipif(find_chromium() is None, reason="no Chromium on this machine")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with Page(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def show(page):
    """Open the page of a model; afterwards nothing may have gone wrong or been fetched from elsewhere."""
    servers = []

    def start(model):
        server = make_server(model, 0)
        servers.append(server)
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        page.send("Page.navigate", url=f"http://127.0.0.1:{server.server_address[1]}/")
        page.wait_for(f"document.title === '{model.name}' && document.getElementById('largest').value")
        return page

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()
    assert page.problems == []
    assert {urlsplit(url).hostname for url in page.requests} <= {"127.0.0.1", None}


def move(page, parameter, value):
    """Move a slider as a hand does, and wait until the page says something new."""
    before = largest(page)
    page.evaluate(
        f"(s => {{ s.value = {value}; s.dispatchEvent(new Event('input', {{bubbles: true}})); }})"
        f"(document.getElementById('parameter-{parameter}'))"
    )
    page.wait_for(f"document.getElementById('largest').value !== '{before}'")
    return largest(page)


def choose(page, key):
    before = largest(page)
    page.evaluate(
        f"(s => {{ s.value = '{key}'; s.dispatchEvent(new Event('change')); }})(document.getElementById('field'))"
    )
    page.wait_for(f"document.getElementById('largest').value !== '{before}'")
    return largest(page)


def largest(page):
    return page.evaluate("document.getElementById('largest').value")


def drawn(page):
    """The picture (h, w, 3) of the solid, and which of its pixels the solid covers."""
    left, top, width, height = page.evaluate(
        "(r => [r.left, r.top, r.width, r.height])(document.getElementById('view').getBoundingClientRect())"
    )
    picture = page.screenshot()[int(top) : int(top + height), int(left) : int(left + width)].astype(int)
    return picture, np.abs(picture - picture[2, 2]).max(axis=2) > 12


def test_a_solid_moves_and_turns(show):
    page = show(stretched_block_model())
    assert largest(page) == "0.000 MPa"
    picture, rest = drawn(page)
    assert 0.03 < rest.mean() < 0.7
    blue, green, red = picture[rest].mean(axis=0)
    assert green < 0.7 * min(blue, red)  # no stress: violet, the lower end of the colours
    assert move(page, "stretch", 0.2) == f"{1e-6 * 0.2 * YOUNG_MODULUS:.4f} MPa"
    text = move(page, "slide", 10)
    stress = 1e-6 * np.hypot(0.2 * YOUNG_MODULUS, 3**0.5 * SHEAR_MODULUS * 0.01 / SIZE[2])
    assert float(text.split()[0]) == pytest.approx(stress, rel=1e-3)
    picture, stretched = drawn(page)
    assert np.ptp(np.nonzero(stretched)[1]) > 1.15 * np.ptp(np.nonzero(rest)[1])  # wider
    blue, _, red = picture[stretched].mean(axis=0)
    assert red > 1.5 * blue  # the upper end
    page.drag((500, 400), (700, 400))
    _, turned = drawn(page)
    assert (turned != stretched).mean() > 0.02
    page.evaluate("document.querySelector('button[type=reset]').click()")
    page.wait_for("document.getElementById('largest').value === '0.000 MPa'")


def test_the_fields_of_a_sheet_and_their_colour_bar(show):
    page = show(bent_sheet_model(17, 13))
    assert move(page, "arch", 40).endswith(" MPa")
    bending = 3e9 * 0.05e-3 / (1 - 0.3**2) * 8 * 0.040 / 0.420**2 * np.sqrt(1 - 0.3 + 0.3**2)
    assert float(largest(page).split()[0]) == pytest.approx(1e-6 * bending, rel=1e-3)
    assert page.evaluate("document.querySelector('#bar figcaption').textContent") == ("von Mises stress, top [MPa]")
    text = choose(page, "displacement")
    assert text.endswith(" mm")
    expected = 1e3 * np.linalg.norm(bent_sheet_model(17, 13).displacement.value(np.array([0.04, 0, 0])), axis=1)
    assert float(text.split()[0]) == pytest.approx(expected.max(), rel=1e-3)
    page.evaluate("document.getElementById('fit').click()")
    top = page.evaluate("document.querySelector('#bar li').textContent")
    assert float(top) == pytest.approx(expected.max(), rel=5e-3)
    _, arched = drawn(page)
    page.evaluate("(s => { s.value = 0; s.dispatchEvent(new Event('input')); })(document.getElementById('scale'))")
    _, flat = drawn(page)
    assert (arched != flat).mean() > 0.01


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
