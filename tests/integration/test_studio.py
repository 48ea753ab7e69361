"""The studio over HTTP, step by step, without a browser."""

import http.client
import inspect
import io
import json
import re
import signal
import ssl
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from morph_dslam import Board, Camera, load_study, save_model
from morph_dslam.extend.geometry import RigidTransform, rotation_exp
from morph_dslam.extend.mechanics import load_mesh
from morph_dslam.studio.project import UPLOADS
from morph_dslam.studio.steps import Steps
from tests.support.documents import PROJECT, samples
from tests.support.processes import ended_at_last
from tests.support.rendered_board import board_image, board_poses
from tests.support.stretched_block import stretched_block_model
from tests.support.studio import Client, running_studio, write_part

CAMERA = Camera(640, 480, 600.0, 600.0, 319.5, 239.5, (-0.1, 0.02, 0.001, 0.0))
POSE = RigidTransform(rotation_exp(np.array([1.9, 0.3, 0.4])), np.array([-0.02, 0.03, 0.35]))


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with running_studio(tmp_path_factory.mktemp("studio") / "project") as server:
        yield server


@pytest.fixture(scope="module")
def client(server):
    return Client(server)


@pytest.fixture(scope="module")
def folder(client):
    """The project folder with an object in it."""
    folder = Path(client.state()["folder"])
    write_part(folder.parent / "part.inp")
    assert client.upload("object", "part.inp", (folder.parent / "part.inp").read_bytes()) == 200
    client.call("load_object", file="part.inp", unit="mm")
    return folder


@pytest.fixture(scope="module")
def placed(client, folder):
    """A project with a model, a camera and images of another size of view."""
    save_model(folder / "model.morph", stretched_block_model())
    text = "width: 640\nheight: 480\nfx: 600.0\nfy: 600.0\ncx: 319.5\ncy: 239.5\ndistortion: [-0.1, 0.02, 0.001, 0.0]\n"
    assert client.upload("camera", "phone.yaml", text.encode()) == 200
    for number in range(3):
        picture = np.full((480, 640, 3), 40 * number, np.uint8)
        _, data = cv2.imencode(".png", picture)
        assert client.upload("frame", f"{number:03d}.png", data.tobytes()) == 200
    return folder


def pairs_of(parameters=(0.0, 0.0), count=12):
    """Points (k, 3) of the block's surface in millimetres and their pixels in the image as recorded (k, 2)."""
    model = stretched_block_model()
    nodes = np.unique(model.triangles)[:: max(1, len(np.unique(model.triangles)) // count)]
    seen = CAMERA.project_recorded(POSE.apply(model.positions(np.array(parameters))[nodes]))
    return np.column_stack([1e3 * model.nodes[nodes], seen])


def test_only_who_has_the_token_is_let_in(server, client):
    for headers, status in (
        ({"Cookie": None}, 401),
        ({"Cookie": f"morph_studio_{server.port}=guess"}, 401),
        ({"Host": "studio.example"}, 403),
        ({"Host": f"127.0.0.1.example:{server.port}"}, 403),
        ({"Host": "[::1"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Origin": "null"}, 403),
    ):
        assert client.ask("GET", "/api/state", **headers)[0] == status
        assert client.ask("POST", "/api/forms", b"{}", **headers)[0] == status
    assert client.ask("POST", "/api/forms", b"{}", Origin=None)[0] == 403
    assert client.ask("GET", "/api/state", Origin=None)[0] == 200
    status, headers, _ = client.ask("GET", f"/?token={server.token}", Cookie=None, Origin=None)
    assert (status, headers["location"]) == (303, "/")
    assert "HttpOnly" in headers["set-cookie"]
    assert "SameSite=strict" in headers["set-cookie"]
    assert client.ask("GET", "/?token=guess", Cookie=None)[0] == 401


def test_the_pages_are_whole_and_load_nothing_from_elsewhere(client):
    status, headers, page = client.ask("GET", "/")
    assert status == 200
    assert "default-src 'self'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    names = {
        "studio.css",
        "studio.js",
        "three/three.module.min.js",
        "three/three.core.min.js",
        "three/OrbitControls.js",
    }
    for name in sorted(names):
        assert client.ask("GET", f"/{name}")[0] == 200
    assert b"//" not in page.replace(b"<!doctype", b"")
    for name in ("server.py", "../app.py", "%2e%2e/app.py", "three/../index.html", "three/LICENSE"):
        assert client.ask("GET", f"/{name}")[0] == 404


def test_an_object_that_is_not_there_is_named(client):
    assert client.refused("load_object", file="gone.inp", unit="mm").startswith("gone.inp is not in the project")


def test_a_repaired_surface_is_named(tmp_path):
    ball = trimesh.creation.icosphere(2, radius=20.0)
    trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False).export(tmp_path / "ball.obj")
    with running_studio(tmp_path / "project") as server:
        client = Client(server)
        assert client.upload("object", "ball.obj", (tmp_path / "ball.obj").read_bytes()) == 200
        surface = client.call("load_object", file="ball.obj", unit="mm")
        assert surface["notes"] == ["the surface of ball.obj was repaired: 1 hole closed"]
        ball.export(tmp_path / "ball.obj")
        assert client.upload("object", "ball.obj", (tmp_path / "ball.obj").read_bytes()) == 200
        assert client.call("load_object", file="ball.obj", unit="mm")["notes"] == []


@pytest.mark.slow
def test_a_camera_file_of_another_size_is_named_before_the_start(tmp_path):
    with running_studio(tmp_path / "project") as server:
        client = Client(server)
        save_model(tmp_path / "project/model.morph", stretched_block_model())
        text = "width: {}\nheight: {}\nfx: 600.0\nfy: 600.0\ncx: 319.5\ncy: 239.5\n"
        assert client.upload("camera", "phone.yaml", text.format(1280, 960).encode()) == 200
        assert client.state()["notes"]["camera"] is None  # of no recording yet
        _, data = cv2.imencode(".png", np.zeros((480, 640, 3), np.uint8))
        assert client.upload("frame", "000.png", data.tobytes()) == 200
        state = client.state()
        said = "the recording is 640x480 pixels but the camera file is for 1280x960"
        assert state["notes"]["camera"].startswith(said)
        assert state["done"]["camera"] is False
        for refused in (client.refused("fit", pairs=[[0.0] * 5] * 4, at_rest=True), client.refused("track")):
            assert refused.startswith(said)
        assert client.upload("camera", "phone.yaml", text.format(640, 480).encode()) == 200
        state = client.state()
        assert (state["notes"]["camera"], state["done"]["camera"]) == (None, True)


def test_the_documented_script(tmp_path, monkeypatch):
    """Its study says nothing of the material, so that the build ends at once and the script with it."""
    monkeypatch.chdir(tmp_path)
    write_part(Path("part.inp"))
    Path("study.toml").write_text('name = "part"\n\n[mesh]\nfile = "mesh.inp"\nunit = "mm"\n')
    (text,) = samples("studio", "python")
    with running_studio(tmp_path / "project") as server:
        told = text.replace("http://127.0.0.1:8766/?token=...", server.address)
        assert told != text
        with pytest.raises(SystemExit, match=r"study\.toml.*material"):
            exec(compile(told, "studio", "exec"), {})
        project = tmp_path / "project"
        assert (project / "study.toml").read_text() == Path("study.toml").read_text()
        assert load_mesh(project / "mesh.inp", "mm").n_cells == load_mesh(Path("part.inp"), "mm").n_cells
        assert Client(server).state()["job"]["command"] == "morph build study.toml -o model.morph"


def test_every_documented_action_is_one(server):
    """With the arguments that the table says."""
    page = (PROJECT / "docs" / "studio.md").read_text().partition("## By a script")[2].partition("## Who can")[0]
    rows = re.findall(r"^\| (`[a-z_`, ]+) \| (.*) \|$", page.partition("| action |")[2], re.MULTILINE)
    actions = {name: words for names, words in rows for name in re.findall(r"`(\w+)`", names)}
    assert len(actions) == 31
    known = Steps(server.project).actions
    arguments = {each for name in actions for each in inspect.signature(known[name]).parameters}
    named = {word for words in actions.values() for word in re.findall(r"`(\w+)`", words)}
    assert named - {"notes", "pairs", "scan", "run", "log", "frames"} <= arguments
    kinds = re.search(r"kinds are (.*) \|", page)[1]
    assert set(re.findall(r"`(\w+)`", kinds)) == set(UPLOADS)


@pytest.mark.slow
def test_faces_grow_up_to_an_angle(client, folder):
    surface = client.call("load_object", file="part.inp", unit="mm")
    assert surface["extent_mm"] == pytest.approx([40, 40, 80])
    nodes, triangles = surface["nodes"].reshape(-1, 3), surface["triangles"].reshape(-1, 3)
    corners = nodes[triangles].astype(float)
    volume = np.einsum("tx,tx->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(0.04 * 0.04 * 0.08, rel=1e-6)  # closed, and outwards
    middle = corners.mean(axis=1)
    top = int(surface["faces"][middle[:, 2].argmax()])
    grown = client.call("grow", face=top, angle=20)
    assert set(grown) == set(surface["faces"][middle[:, 2] > 0.0799].tolist())
    assert len(client.call("grow", face=top, angle=90)) == surface["n_faces"] == 90
    assert "there is no face 90" in client.refused("grow", face=90, angle=20)


def test_named_sets_are_in_the_mesh_that_is_written(client, folder):
    surface = client.call("load_object", file="part.inp", unit="mm")
    middle = surface["nodes"].reshape(-1, 3)[surface["triangles"].reshape(-1, 3)].mean(axis=1)
    for name, at in (("foot", middle[:, 2].argmin()), ("head", middle[:, 2].argmax())):
        client.call("name_set", name=name, faces=client.call("grow", face=int(surface["faces"][at]), angle=20))
    mesh = load_mesh(folder / "mesh.inp", "mm")
    assert mesh.nodes[mesh.surface_nodes("head")][:, 2] == pytest.approx(0.08)
    assert len(mesh.surface("foot")) == 9
    for name in ("2nd", "a b", "all", "x" * 50, "../x"):
        assert "no name for a set" in client.refused("name_set", name=name, faces=[0])
    assert "one at least" in client.refused("name_set", name="none", faces=[])
    assert sorted(client.state()["choices"]["sets"]) == ["foot", "head"]


def test_forms_and_the_text_change_the_same_study(client, folder):
    test_named_sets_are_in_the_mesh_that_is_written(client, folder)
    found = client.call("write_study", text=(folder / "study.toml").read_text() + "# kept\n")
    assert found["problems"] == ["materials is missing; parameters is missing"]
    client.call("change_study", section="parameters", key="push", value={"range": ["-4 mm", "12 mm"]})
    entry = next(one for one in client.call("forms")["materials"] if one["name"] == "natural_rubber")
    client.call("change_study", section="materials", key="natural_rubber", value=entry["section"])
    client.call("change_study", section="supports", key=0, value={"kind": "fixed", "on": "foot"})
    move = {"kind": "displacement", "on": "head", "x": "push", "y": "0 mm", "z": "0 mm"}
    found = client.call("change_study", section="supports", key=1, value=move)
    assert found["problems"] == []
    # The picked ones, and the flat ends that a mesh has by itself.
    ends = [f"{axis}_{end}" for axis in "xyz" for end in ("max", "min")]
    assert found["sets"] == ["foot", "head", *ends]
    assert "# kept" in found["text"]
    study = load_study(folder / "study.toml")
    assert [support.on for support in study.supports] == ["foot", "head"]
    assert client.state()["done"]["study"]
    found = client.call("write_study", text=found["text"].replace('on = "head"', 'on = "hand"'))
    assert "the mesh has no node set or surface 'hand'; it has: foot, head" in found["problems"][0]
    found = client.call("change_study", section="supports", key=1)
    assert len(tomllib.loads(found["text"])["supports"]) == 1
    before = found["text"]
    assert "is not TOML" in client.refused("write_study", text="name = ")
    for path in ("../part.inp", "/etc/passwd", "C:\\\\part.inp", "sub/../../part.inp"):
        assert "leads out of the project" in client.refused("write_study", text=f'[mesh]\nfile = "{path}"\n')
    assert (folder / "study.toml").read_text() == before


def test_pairs_place_the_object_and_name_the_worst(client, placed):
    pairs = pairs_of()
    assert client.call("fit", pairs=pairs[:3].tolist(), at_rest=True)["message"] == "click 1 more pair"
    found = client.call("fit", pairs=pairs.tolist(), at_rest=True)
    assert found["rms_px"] < 1e-3
    model = stretched_block_model()
    seen = CAMERA.project_recorded(POSE.apply(model.nodes[np.unique(model.triangles)]))
    np.testing.assert_allclose(found["pixels"].reshape(-1, 2), seen, atol=2e-3)
    assert 0 < len(found["order"]) < len(model.triangles)  # the back of a solid is not drawn
    pairs[4, 3] += 3.0
    found = client.call("fit", pairs=pairs.tolist(), at_rest=True)
    quick = client.call("fit", pairs=pairs.tolist(), at_rest=True, quick=True)
    np.testing.assert_allclose(quick["residuals_px"], found["residuals_px"], atol=1e-3)
    assert found["worst"] == quick["worst"] == 4
    assert 1.0 < found["residuals_px"][4] < 3.0
    pairs[4, 3] += 60.0
    said = client.refused("fit", pairs=pairs.tolist(), at_rest=True)
    assert float(re.search(r"landmark 5 is ([0-9.]+) px from where the other", said)[1]) == pytest.approx(63.0, abs=1.0)


def test_clicks_become_the_landmarks_of_the_command_line(client, placed):
    pairs = pairs_of((0.1, 0.005))
    found = client.call("fit", pairs=pairs.tolist(), at_rest=False)
    assert list(found["parameters"].values()) == pytest.approx([0.1, 0.005], abs=1e-4)
    client.call("save_start", pairs=pairs.tolist(), frame=1, at_rest=False)
    lines = (placed / "landmarks.csv").read_text().splitlines()
    assert lines[0] == "x_mm,y_mm,z_mm,u_px,v_px"
    assert len(lines) == 1 + len(pairs)
    again = client.call("start_files")
    assert (again["frame"], again["at_rest"]) == (1, False)
    np.testing.assert_allclose(again["pairs"], pairs, atol=1e-3)


def test_frames_come_in_any_order(client, placed):
    for number in (2, 0, 1, 1):
        status, headers, content = client.ask("GET", f"/api/frame/{number}")
        assert (status, headers["content-type"]) == (200, "image/jpeg")
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        assert picture.mean() == pytest.approx(40 * number, abs=2)
    assert client.ask("GET", "/api/frame/3")[0] == 400


def test_a_photograph_says_its_focal_length(client, placed):
    """27 mm on film of 43.27 mm diagonal: of 800 pixels' diagonal 499.2 pixels."""
    before = (placed / "camera.yaml").read_text()
    picture, data, exif = Image.new("RGB", (64, 48)), io.BytesIO(), Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 27
    picture.save(data, "jpeg", exif=exif)
    assert client.upload("photo", "photo.jpg", data.getvalue()) == 200
    assert "Guess: focal length 499 px" in client.call("guess_camera", photo="photo.jpg")["note"]
    assert client.state()["camera"]["fx"] == pytest.approx(27 / 43.2666 * 800, abs=0.01)
    data = io.BytesIO()
    picture.save(data, "jpeg")
    assert client.upload("photo", "plain.jpg", data.getvalue()) == 200
    assert "does not say its focal length" in client.refused("guess_camera", photo="plain.jpg")
    (placed / "camera.yaml").write_text(before)


def test_a_command_runs_and_tells_how_far_it_is(client, placed):
    """The states of a table are exported; its last line and its status come as events."""
    (placed / "run").mkdir()
    header = ",".join(f"{p.name}_{p.unit}" for p in stretched_block_model().parameters)
    (placed / "run/frames.csv").write_text(f"{header}\n0,0\n0.1,2\n")
    client.call("export", format="gltf")
    assert "still runs" in client.refused("build")
    events = client.events(lambda name, job: name == "job" and job is not None and not job["running"])
    job = events[-1][1]
    assert job["command"] == "morph export model.morph --format gltf --path run/frames.csv -o export-gltf"
    assert job["status"] == 0, job["lines"]
    assert (placed / "export-gltf" / "states.csv").is_file()
    client.call("build")
    client.call("stop")
    job = client.state()["job"]
    assert (job["running"], job["stopped"]) == (False, True)


def test_lines_of_a_run_come_as_they_are_written(client, placed):
    rows = [{"frame": number, "status": "lost", "camera_from_object": None, "parameters": {}} for number in (0, 1)]
    (placed / "track.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"frame": 2, "sta')
    name, content = client.events(lambda name, _: name == "frames")[-1]
    assert (name, content["frames"]) == ("frames", rows)
    assert "was not tracked in frame 1" in client.refused("overlay", frame=1)
    (placed / "track.jsonl").unlink()


def test_the_explorer_is_served_too(client, placed):
    assert client.ask("GET", "/explore/")[0] == 200
    assert json.loads(client.ask("GET", "/explore/model.json")[2])["name"] == stretched_block_model().name
    assert client.ask("GET", "/explore/state.bin?mu=nothing&field=displacement")[0] == 400
    assert client.ask("GET", "/explore/absent")[0] == 404


def test_without_the_extra_there_is_one_message():
    program = (
        "import sys; sys.modules['starlette'] = None; import importlib.util as u; find = u.find_spec;"
        "u.find_spec = lambda name, *rest: None if name == 'starlette' else find(name, *rest);"
        "from morph_dslam.cli import main; sys.exit(main(['studio', '--port', '0']))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.strip() == (
        "morph: morph studio needs starlette, which is not installed: run `pip install '.[studio]'` in "
        "the project's folder"
    )


@pytest.mark.slow
def test_it_ends_quietly_although_a_page_is_open(tmp_path):
    program = "import sys; from morph_dslam.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "studio", str(tmp_path / "project"), "--port", "0", "--host", "0.0.0.0"]
    with ended_at_last(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)) as process:
        line = process.stdout.readline()
        port, token = re.search(r"http://[^ ]+:(\d+)/\?token=([\w-]+) \(Ctrl-C ends it\)", line).groups()
        statuses, opened = {}, []
        for host in (f"127.0.0.1:{port}", f"192.168.7.8:{port}", f"studio.example:{port}"):
            page = http.client.HTTPConnection("127.0.0.1", int(port), timeout=30)
            page.request("GET", "/api/events", headers={"Host": host, "Cookie": f"morph_studio_{port}={token}"})
            opened += [page.getresponse(), page]
            statuses[host.partition(":")[0]] = opened[-2].status
        assert statuses == {"127.0.0.1": 200, "192.168.7.8": 200, "studio.example": 403}
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stderr.read() == ""
        for each in opened:
            each.close()


def test_a_port_that_is_taken_is_one_message(server, refused):
    assert f"127.0.0.1:{server.port} cannot be taken" in refused("studio", "--port", str(server.port))


def test_a_phone_is_let_in_once_to_bring_a_recording(tmp_path):
    """Over HTTPS with a certificate that nobody else has signed."""
    _, data = cv2.imencode(".png", np.zeros((24, 32, 3), np.uint8))
    writer = cv2.VideoWriter(str(tmp_path / "phone.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, (32, 24))
    for _ in range(3):
        writer.write(cv2.imdecode(data, cv2.IMREAD_COLOR))
    writer.release()
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with running_studio(tmp_path / "project", phone=True) as server:

        def ask(method, path, body=b"", **headers):
            connection = http.client.HTTPSConnection("127.0.0.1", server.phone_port, timeout=30, context=context)
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            content = answer.read()
            connection.close()
            return answer.status, answer.getheader("set-cookie"), content

        computer = Client(server)
        token = computer.state()["phone"].partition("token=")[2]
        code = cv2.imdecode(np.frombuffer(computer.ask("GET", "/api/phone.png")[2], np.uint8), cv2.IMREAD_GRAYSCALE)
        assert cv2.QRCodeDetectorAruco().detectAndDecode(code)[0] == computer.state()["phone"]
        assert ask("GET", "/")[0] == ask("GET", "/?token=guess")[0] == ask("GET", f"/?token={server.token}")[0] == 401
        status, cookie, _ = ask("GET", f"/?token={token}")
        assert status == 303
        assert "Secure" in cookie
        assert ask("GET", f"/?token={token}")[0] == 401  # once
        assert computer.state()["phone"].partition("token=")[2] not in ("", token)
        own = {"Cookie": cookie.partition(";")[0], "Origin": f"https://127.0.0.1:{server.phone_port}"}
        assert b"/phone.js" in ask("GET", "/", **own)[2]
        for path in ("/api/state", "/api/events", "/report", "/files/study.toml", "/studio.js", "/explore/"):
            assert ask("GET", path, **own)[0] == 404
        assert ask("PUT", "/api/upload/object/part.stl", b"solid", **own)[0] == 404
        video = (tmp_path / "phone.mp4").read_bytes()
        assert ask("PUT", "/api/upload/recording/phone.mp4", video, Cookie=own["Cookie"])[0] == 403
        assert computer.state()["recording"] is None
        assert ask("PUT", "/api/upload/recording/phone.mp4", video, **own)[0] == 200
        assert computer.state()["recording"]["frames"] == 3


def test_an_upload_that_breaks_off_leaves_nothing(server, client, folder):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    connection.putrequest("PUT", "/api/upload/object/half.stl", skip_host=True)
    for name, value in (client.own | {"Content-Length": "1000"}).items():
        connection.putheader(name, value)
    connection.endheaders(b"solid")
    connection.close()
    assert client.ask("PUT", "/api/upload/camera/big.yaml", b"", **{"Content-Length": "2000000"})[0] in (400, 413)
    assert not any(name.startswith(("half.stl", "big.yaml")) for name in client.state()["files"])


@pytest.mark.slow
def test_pictures_of_a_board_give_the_camera(client, folder):
    """Rendered pictures of a checkerboard; the focal length is that of the camera that rendered them."""
    board = Board(9, 6, 0.025)
    camera = Camera(640, 480, 541.0, 538.5, 327.3, 236.1, (-0.27, 0.09, 8e-4, -5e-4))
    client.call("forget_frames", folder="board")
    for number, pose in enumerate(board_poses(camera, board, 16, 40.0, seed=2)):
        _, data = cv2.imencode(".png", board_image(camera, board, pose, number))
        assert client.upload("board", f"{number}.png", data.tobytes()) == 200
    client.call("calibrate", board="9x6", square="25 mm", lens="radial-tangential")
    job = client.events(lambda name, job: name == "job" and job is not None and not job["running"])[-1][1]
    assert job["status"] == 0, job["lines"]
    found = client.state()["camera"]
    assert (found["fx"], found["fy"]) == pytest.approx((541.0, 538.5), rel=2e-3)
    assert "square" in client.refused("calibrate", board="9x6", square="-o x", lens="fisheye")
