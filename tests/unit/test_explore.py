"""What `morph explore` serves: shapes and states in closed form, to this computer only."""

import http.client
import json
import re
import signal
import socket
import struct
import subprocess
import sys
import threading

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.errors import ExploreError
from morph_dslam.explorer.server import ModelPages, make_server
from morph_dslam.extend.studies import build_rigid
from morph_dslam.io.access import HOST
from morph_dslam.model import save_model
from tests.support.bent_sheet import bent_sheet_model
from tests.support.processes import ended_at_last
from tests.support.stretched_block import SHEAR_MODULUS, SIZE, YOUNG_MODULUS, stretched_block_model


@pytest.fixture
def serve():
    """Start servers for models; each is a function from a path to (status, content type, content)."""
    servers = []

    def start(model):
        server = make_server(model, 0)
        servers.append(server)
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()

        def get(path, host=None, method="GET"):
            connection = http.client.HTTPConnection(*server.server_address, timeout=20)
            headers = {"Host": host} if host else {}
            connection.request(method, path, headers=headers)
            answer = connection.getresponse()
            found = answer.status, answer.getheader("Content-Type"), answer.read()
            connection.close()
            return found

        get.port = server.server_address[1]
        return get

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def numbers(get, path):
    status, _, content = get(path)
    assert status == 200, content
    return np.frombuffer(content, dtype="<f4")


def test_a_solid_in_a_state(serve):
    get = serve(stretched_block_model())
    description = json.loads(get("/model.json")[2])
    assert [f["key"] for f in description["fields"]] == ["displacement", "solid"]
    assert description["parameters"][1] == {
        "name": "slide", "description": "motion of the top along x", "unit": "mm",
        "lower": pytest.approx(-10), "upper": pytest.approx(10), "default": 0,
    }  # fmt: skip
    n, m = description["nodes"], description["triangles"]
    assert (n, m) == (12, 20)
    shape = get("/shape.bin")[2]
    nodes = np.frombuffer(shape[: 12 * n], dtype="<f4").reshape(n, 3)
    triangles = np.frombuffer(shape[12 * n :], dtype="<u4").reshape(m, 3)
    corners = nodes[triangles].astype(float)
    volume = np.linalg.det(corners).sum() / 6.0  # of the closed surface, if it turns outwards
    assert volume == pytest.approx(np.prod(SIZE), rel=1e-6)
    state = numbers(get, "/state.bin?mu=0.1,5&field=solid")
    slope = 0.005 / SIZE[2]
    moved, stress = state[: 3 * n].reshape(n, 3), state[3 * n :]
    np.testing.assert_allclose(moved[:, 0], 0.1 * nodes[:, 0] + slope * nodes[:, 2], atol=1e-8)
    np.testing.assert_array_equal(moved[:, 1:], 0.0)
    expected = 1e-6 * np.hypot(0.1 * YOUNG_MODULUS, 3**0.5 * SHEAR_MODULUS * slope)
    np.testing.assert_allclose(stress, expected, rtol=1e-5)
    distance = numbers(get, "/state.bin?mu=0.1,5&field=displacement")[3 * n :]
    np.testing.assert_allclose(distance, 1e3 * moved[:, 0], rtol=1e-5)


def test_both_faces_of_a_sheet(serve):
    model = bent_sheet_model(9, 7)
    model.stresses["bottom"] = model.stresses["top"].restrict(np.arange(63)[:, None], np.full((63, 1), 2.0))
    get = serve(model)
    description = json.loads(get("/model.json")[2])
    assert [f["label"] for f in description["fields"]] == [
        "displacement", "von Mises stress, top", "von Mises stress, bottom",
    ]  # fmt: skip
    top, bottom = (numbers(get, f"/state.bin?mu=40,0,0&field={face}")[3 * 63 :] for face in ("top", "bottom"))
    # As in the export's test: an arch of 40 mm over 420 mm, bent as a plate.
    bending = 3e9 * 0.05e-3 / (1 - 0.3**2) * 8 * 0.040 / 0.420**2
    np.testing.assert_allclose(top, 1e-6 * bending * np.sqrt(1 - 0.3 + 0.3**2), rtol=1e-5)
    np.testing.assert_allclose(bottom, 2.0 * top, rtol=1e-6)


def test_one_range_of_colours_for_the_whole_box(serve):
    """The displacement's lies at or above that of nearly all states, and not far above the largest."""
    fields = json.loads(serve(stretched_block_model())("/model.json")[2])["fields"]
    largest_motion = 1e3 * (0.2 * SIZE[0] + 0.010)
    largest_stress = 1e-6 * np.hypot(0.2 * YOUNG_MODULUS, 3**0.5 * SHEAR_MODULUS * 0.01 / SIZE[2])
    for field, largest in zip(fields, (largest_motion, largest_stress), strict=True):
        assert 0.7 * largest < field["top"] < 1.5 * largest


def test_values_outside_the_box_are_those_at_its_end(serve):
    get = serve(stretched_block_model())
    ends = [numbers(get, f"/state.bin?mu={mu},0&field=solid") for mu in ("0.2", "0.7")]
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("", "'mu' is missing"),
        ("mu=0,0", "'field' is missing"),
        ("mu=0,0&field=top", "'top' is missing, or no field of this model"),
        ("mu=0&field=solid", "'0' is not 2 numbers"),
        ("mu=0,0,0&field=solid", "'0,0,0' is not 2 numbers"),
        ("mu=0,x&field=solid", "'0,x' is not 2 numbers"),
        ("mu=0,nan&field=solid", "not finite"),
    ],
)
def test_requests_that_make_no_state(serve, query, message):
    status, content_type, content = serve(stretched_block_model())(f"/state.bin?{query}")
    assert status == 400
    assert content_type.startswith("text/plain")
    assert message in content.decode()


def test_the_page_is_whole_and_nothing_else_is_served(serve):
    get = serve(stretched_block_model())
    for path, content_type in (
        ("/", "text/html"), ("/explore.css", "text/css"), ("/explore.js", "text/javascript"),
        ("/solid_view.js", "text/javascript"), ("/colour_bar.js", "text/javascript"),
        ("/three/three.module.min.js", "text/javascript"), ("/three/three.core.min.js", "text/javascript"),
        ("/three/OrbitControls.js", "text/javascript"),
    ):  # fmt: skip
        status, found, content = get(path)
        assert (status, found.split(";")[0]) == (200, content_type)
        assert len(content) > 500
    assert b"://" not in get("/")[2]  # nothing is fetched from elsewhere
    for path in ("/absent", "/server.py", "/../server.py", "/three/%2e%2e/index.html", "/three/LICENSE"):
        assert get(path)[0] == 404
    assert get("/", method="POST")[0] == 501


def test_only_this_computer_is_answered(serve):
    assert HOST == "127.0.0.1"
    get = serve(stretched_block_model())
    for host, status in (("localhost:8765", 200), ("127.0.0.1", 200), ("example.org:8765", 403), ("[", 403)):
        assert get("/model.json", host=host)[0] == status


def test_a_model_without_parameters_is_shown_as_it_is(serve, tmp_path):
    (tmp_path / "corner.obj").write_text("v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    model = build_rigid(tmp_path / "corner.obj", "mm")
    get = serve(model)
    description = json.loads(get("/model.json")[2])
    assert (description["parameters"], [field["key"] for field in description["fields"]]) == ([], ["displacement"])
    status, _, state = get("/state.bin?mu=&field=displacement")
    assert status == 200
    np.testing.assert_array_equal(np.frombuffer(state, dtype="<f4"), np.zeros(4 * len(model.nodes)))


def test_a_port_that_is_taken():
    model = stretched_block_model()
    with make_server(model, 0) as server:
        for taken in (server.server_address[1], 70000):
            with pytest.raises(ExploreError, match=f"port {taken} cannot be taken"):
                md.explore(model, taken)


def test_the_command_serves_until_it_is_interrupted(tmp_path):
    save_model(tmp_path / "block.morph", stretched_block_model())
    program = (
        "import signal, sys; from morph_dslam.cli import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have switched it off\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", program, "explore", str(tmp_path / "block.morph"), "--port", "0"]
    with ended_at_last(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)) as process:
        (port,) = re.findall(r"http://127\.0\.0\.1:(\d+)/", process.stdout.readline())
        connection = http.client.HTTPConnection(HOST, int(port), timeout=20)
        connection.request("GET", "/model.json")
        assert json.loads(connection.getresponse().read())["name"] == "stretched block"
        connection.close()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")


def test_a_page_that_is_closed_at_once_is_no_error(serve, capfd):
    get = serve(stretched_block_model())
    for _ in range(20):
        with socket.create_connection((HOST, get.port)) as closed:
            closed.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset, not end
            closed.sendall(b"GET /three/three.core.min.js HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert get("/model.json")[0] == 200
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("target", ["//[", "http://[", "[?mu=1"])
def test_what_is_no_url_is_not_there(target):
    assert ModelPages(stretched_block_model()).answer(target) is None


@pytest.mark.parametrize("target", ["http://127.0.0.1:8080/model.json", "HTTP://localhost/model.json?now=1"])
def test_a_target_in_absolute_form_is_answered(target):
    pages = ModelPages(stretched_block_model())
    assert pages.answer(target) == pages.answer("/model.json")
    assert pages.answer("http://localhost") == pages.answer("/")
