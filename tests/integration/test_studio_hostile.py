"""The studio under hostile requests and files: each gets an answer, nothing leaves the folder, nothing breaks."""

import contextlib
import gzip
import json
import random
import socket
import struct
import types
import typing
from pathlib import Path

import cv2
import meshio
import numpy as np
import pytest

from morph_dslam import save_model
from morph_dslam.extend.mechanics import block
from morph_dslam.studio.project import UPLOADS, Project
from morph_dslam.studio.steps import Steps
from tests.support.stretched_block import stretched_block_model
from tests.support.studio import Client, running_studio, write_part

SECRET = b"1, 0.25, 0.5, 0.75 only for the owner"
WORDS = (
    "..", "../secret.txt", "..%2fsecret.txt", "%2e%2e/secret.txt", "/etc/passwd", "~/x", ".hidden",
    "a/../../secret.txt", "link/secret.txt", "secret.txt", "study.toml", "mesh.inp", "C:\\x", "a\x00b", "\u202e",
    "x" * 5000, "-o", "--help", "frames", "board", "", " ", "{}", "null", "$(id)", "`id`", "'; drop",
    "<script>", "nan", "1e999", "-1", "part.inp",
)  # fmt: skip
#: Actions that there are not; those that there are, are asked for of the studio itself.
NO_ACTIONS = ("close", "__init__", "_worker", "state", "../build", "%2e%2e", "")
NO_KINDS = ("secret", "..", "", "%2e%2e")
SUFFIXES = (".stl", ".obj", ".ply", ".inp", ".msh", ".vtu", ".vtk", ".yaml", ".mp4", ".png", ".jpg", ".csv", ".py", "")


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    """A client of a studio, its project folder, and the folder around it with a secret and a link to it."""
    around = tmp_path_factory.mktemp("hostile")
    (around / "secret.txt").write_bytes(SECRET)
    with running_studio(around / "project", takes_over=False) as server:
        (around / "project" / "link").symlink_to(around)
        client = Client(server)
        write_part(around / "part.inp")
        assert client.upload("object", "part.inp", (around / "part.inp").read_bytes()) == 200
        yield client, around


def outside(around):
    """What lies around the project folder."""
    # The project itself is not walked through: uploads come and go there.
    beside = [path for path in around.iterdir() if path.name != "project"]
    files = [path for top in beside for path in (top, *top.rglob("*"))]
    return {path: path.read_bytes() for path in files if path.is_file()}


#: What is rarely meant by a value of each type.
NUMBERS = (0, -1, 1, 2**31, -(2**63), 10**30, 0.5, -0.0, 1e308, 1e-320)


def any_value(random_, depth=0):
    """A value of no type in particular."""
    kind = random_.randrange(5)
    if kind == 0 and depth < 4:
        return [any_value(random_, depth + 1) for _ in range(random_.randrange(4))]
    if kind == 1 and depth < 4:
        return {random_.choice(WORDS[:12]): any_value(random_, depth + 1) for _ in range(random_.randrange(3))}
    return random_.choice((None, True, False, random_.choice(NUMBERS), random_.choice(WORDS)))


def value_of(random_, hint):
    """A value of the type that an argument has: one that may reach what is behind the check of types."""
    kind, parts = typing.get_origin(hint), typing.get_args(hint)
    if kind is typing.Annotated:
        return value_of(random_, parts[0])
    if kind is typing.Literal:
        return random_.choice(parts)
    if kind in (typing.Union, types.UnionType):
        return value_of(random_, random_.choice(parts))
    if kind is list:
        return [value_of(random_, parts[0]) for _ in range(random_.choice((0, 1, 4, 5, 60)))]
    plain = {bool: (True, False), type(None): (None,), str: WORDS, int: (*range(9), *NUMBERS[:6]), float: NUMBERS}
    return random_.choice(plain[hint]) if hint in plain else any_value(random_)


def some_arguments(random_, action):
    """Arguments of an action: most of them of their types, some of others, some left out, some that it has not."""
    hints = typing.get_type_hints(action, include_extras=True)
    hints.pop("return", None)
    arguments = {}
    for name, hint in hints.items():
        if random_.random() < 0.85:
            arguments[name] = value_of(random_, hint) if random_.random() < 0.75 else any_value(random_)
    if random_.random() < 0.1:
        arguments[random_.choice(("self", "project", "seconds", "x" * 300, "\u202e"))] = any_value(random_)
    return arguments


def some_request(random_, actions):
    """Method, path, body and headers of a request."""
    kind = random_.randrange(8)
    name = random_.choice((*actions, *NO_ACTIONS))
    if kind == 0:
        word = "".join(c if c.isprintable() and c.isascii() and c != " " else "%00" for c in random_.choice(WORDS))
        place = random_.choice(("files", "explore", "api/frame", "api/scan", ""))
        return random_.choice(("GET", "GET", "DELETE", "PUT")), f"/{place}/{word}", b"", {}
    if kind == 1:
        word = "".join(c if c.isalnum() or c in "._/%-" else "%41" for c in random_.choice(WORDS))[:300] or "x"
        body, suffix = random_.randbytes(random_.randrange(2000)), random_.choice(SUFFIXES)
        return "PUT", f"/api/upload/{random_.choice((*UPLOADS, *NO_KINDS))}/{word}{suffix}", body, {}
    if kind == 2:
        body = random_.choice(
            (b"", b"[]", b"null", b"{", b"[" * 100_000, b'{"a":' * 5000, b"NaN", b'{"frame": NaN}', b"\xff",
             b'{"text": "\\ud800"}', b'{"a": 1e999}', b'{"frame": ' + b"9" * 5000 + b"}")
        )  # fmt: skip
        return "POST", f"/api/{name}", body, {}
    if kind == 3:
        header = random_.choice(("Host", "Origin", "Cookie", "Range", "Accept", "Content-Type", "Transfer-Encoding"))
        headers = {header: random_.choice(("", "x", "null", "[", "a" * 5000, "bytes=-1-", "bytes=9-1", "gzip"))}
        path = random_.choice(("/", "/api/state", "/report", "/files/study.toml"))
        return random_.choice(("GET", "POST", "HEAD", "OPTIONS", "TRACE")), path, b"", headers
    arguments = some_arguments(random_, actions[name]) if name in actions else {"a": any_value(random_)}
    return "POST", f"/api/{name}", json.dumps(arguments).encode(), {}


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory):
    """Content of a file of each kind that is uploaded, by kind and name."""
    folder, mesh = tmp_path_factory.mktemp("files"), block((0.04, 0.04, 0.08), (2, 2, 2), "hex8")
    surface = meshio.Mesh(mesh.nodes, [("triangle", mesh.surface_triangles())])
    solid = meshio.Mesh(mesh.nodes, [("hexahedron", mesh.blocks[0].connectivity)])
    for name in ("a.stl", "a.obj", "a.ply"):
        surface.write(folder / name)
    for name, more in (("a.vtu", {}), ("a.vtk", {}), ("a.msh", {"file_format": "gmsh"})):
        solid.write(folder / name, **more)
    write_part(folder / "a.inp")
    image = np.random.default_rng(3).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    writer = cv2.VideoWriter(str(folder / "v.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, (64, 48))
    for _ in range(4):
        writer.write(image)
    writer.release()
    for name in ("0.png", "0.jpg"):
        cv2.imwrite(str(folder / name), image)
    (folder / "c.yaml").write_text("width: 64\nheight: 48\nfx: 60.0\nfy: 60.0\ncx: 31.5\ncy: 23.5\n")
    (folder / "l.csv").write_text("x_mm,y_mm,z_mm,u_px,v_px\n" + "1,2,3,4,5\n" * 6)
    kinds = {".mp4": ("recording", "scan"), ".png": ("frame",), ".jpg": ("photo", "board"), ".yaml": ("camera",),
             ".csv": ("landmarks",)}  # fmt: skip
    found = {}
    for path in sorted(folder.iterdir()):
        for kind in kinds.get(path.suffix, ("object",)):
            found[kind, path.name] = path.read_bytes()
    return found


@pytest.fixture(scope="module")
def project(tmp_path_factory, whole_files):
    """A client of a studio whose project has a file of each kind, and the folder around it with a secret.

    The map and the place in it are broken ones.
    """
    around = tmp_path_factory.mktemp("hostile")
    folder = around / "project"
    (around / "secret.txt").write_bytes(SECRET)
    with running_studio(folder, takes_over=False) as server:
        (folder / "link").symlink_to(around)
        client = Client(server)
        for (kind, name), content in whole_files.items():
            assert client.upload(kind, name, content) == 200
        client.call("load_object", file="a.inp", unit="mm")
        save_model(folder / "model.morph", stretched_block_model())
        for name in ("map", "place", "run"):
            (folder / name).mkdir()
        (folder / "map/map.h5").write_bytes(b"\x89HDF")
        for name in ("map/summary.json", "place/registration.json", "run/summary.json"):
            (folder / name).write_text("{}")
        (folder / "run/frames.csv").write_text("frame,slide_mm,stretch_1\n0,1,0.1\n")
        yield client, around


@pytest.mark.parametrize("seed", [19, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(20, 26))])
def test_hostile_requests_are_answered_and_nothing_else(project, tmp_path, capfd, seed):
    """500 requests over all actions that the studio has."""
    client, around = project
    actions = Steps(Project(tmp_path / "other")).actions
    before, random_ = outside(around), random.Random(seed)
    statuses, asked = set(), set()
    for _ in range(500):
        method, path, body, headers = some_request(random_, actions)
        status, _, content = client.ask(method, path, body, **headers)
        statuses.add(status)
        asked.add(path.rpartition("/")[2])
        assert status < 500, (method, path, body[:200], content[:200])
        assert SECRET not in content
        assert b"Traceback" not in content
    client.call("stop")
    assert b"Traceback" not in client.ask("GET", "/api/state")[2]  # nor in what commands have said
    assert {200, 400, 401, 403, 404, 405} <= statuses
    assert set(actions) <= asked
    assert outside(around) == before
    assert "Traceback" not in capfd.readouterr().err
    assert client.call("forms")["laws"]


RAW = (
    b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", b"\x00" * 500, b"GET\r\n\r\n",
    b"POST /api/forms HTTP/1.1\r\nHost: HOST\r\nContent-Length: -1\r\n\r\n{}",
    b"POST /api/forms HTTP/1.1\r\nHost: HOST\r\nOWN\r\nContent-Length: 1e9\r\n\r\n{}",
    b"POST /api/forms HTTP/1.1\r\nHost: HOST\r\nOWN\r\nContent-Length: 99999999999999999999999\r\n\r\n{}",
    b"PUT /api/upload/object/a.stl HTTP/1.1\r\nHost: HOST\r\nOWN\r\nContent-Length: 999999999999\r\n\r\nsolid",
    b"PUT /api/upload/object/a.stl HTTP/1.1\r\nHost: HOST\r\nOWN\r\nTransfer-Encoding: chunked\r\n\r\n-5\r\nsolid\r\n",
    b"PUT /api/upload/object/a.stl HTTP/1.1\r\nHost: HOST\r\nOWN\r\nTransfer-Encoding: chunked\r\n\r\n"
    b"FFFFFFFFFFFFFFFF\r\nx",
    b"POST /api/forms HTTP/1.1\r\nHost: HOST\r\nOWN\r\nContent-Length: 2\r\nContent-Length: 5\r\n\r\n{}",
    b"GET /" + b"a" * 200_000 + b" HTTP/1.1\r\nHost: HOST\r\n\r\n", b"GET /\x00\xff HTTP/1.1\r\nHost: HOST\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: HOST\r\nX: " + b"a" * 500_000 + b"\r\n\r\n",
    b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 50_000 + b"\r\n", b"GET http://[::1 HTTP/1.1\r\nHost: HOST\r\n\r\n",
)  # fmt: skip


@pytest.mark.parametrize("number", range(len(RAW)))
def test_bytes_that_are_no_request_are_refused(studio, capfd, number):
    """Lengths that are negative, huge or contradict each other, headers without end, and what is not HTTP."""
    client, around = studio
    before = outside(around)
    own = "\r\n".join(f"{name}: {value}" for name, value in client.own.items() if name != "Host")
    sent = RAW[number].replace(b"HOST", client.own["Host"].encode()).replace(b"OWN", own.encode())
    with socket.create_connection(("127.0.0.1", int(client.own["Host"].partition(":")[2])), 30) as connection:
        with contextlib.suppress(OSError):  # it may hang up before all is sent
            connection.sendall(sent)
            connection.shutdown(socket.SHUT_WR)
        answer = b""
        with contextlib.suppress(OSError):
            while data := connection.recv(1 << 16):
                answer += data
    assert answer == b"" or 400 <= int(answer.split()[1]) < 500, answer[:200]
    assert b"Traceback" not in answer
    assert outside(around) == before
    assert not any(name.startswith("a.stl") for name in client.state()["files"])
    assert "Traceback" not in capfd.readouterr().err


def broken(random_, content):
    """A file with some bits turned over, a part cut out, or its end cut off."""
    data = bytearray(content)
    for _ in range(random_.choice((0, 1, 3, 30))):
        data[random_.randrange(len(data))] ^= 1 << random_.randrange(8)
    if random_.random() < 0.4:
        del data[random_.randrange(len(data)) :]
    elif random_.random() < 0.3:
        start = random_.randrange(len(data))
        del data[start : start + random_.randrange(200)]
    return bytes(data)


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 12))])
def test_broken_files_are_read_or_refused(studio, whole_files, capfd, seed):
    """Each kind of file with bits turned over and parts cut off, and what reads it after it is there."""
    client, around = studio
    before, random_ = outside(around), random.Random(seed)
    assert {kind for kind, _ in whole_files} == set(UPLOADS)
    reads = {
        "object": lambda name: ("load_object", {"file": name, "unit": "mm"}), "scan": lambda _: ("scan", {}),
        "photo": lambda name: ("guess_camera", {"photo": name}), "landmarks": lambda _: ("start_files", {}),
    }  # fmt: skip
    for (kind, name), content in whole_files.items():
        for _ in range(4):
            status, _, answer = client.ask("PUT", f"/api/upload/{kind}/{name}", broken(random_, content))
            assert status in (200, 400), (kind, name, answer[:300])
            if kind in reads:
                action, arguments = reads[kind](name)
                status, _, answer = client.ask("POST", f"/api/{action}", json.dumps(arguments).encode())
            else:
                status, _, answer = client.ask("GET", "/api/frame/0")
            assert status in (200, 400), (kind, name, answer[:300])
            assert b"Traceback" not in answer
            assert client.ask("GET", "/api/state")[0] == 200, (kind, name)
    study = b'name = "a"\n[mesh]\nfile = "mesh.inp"\nunit = "mm"\n[materials.a]\nyoung = "3 MPa"\npoisson = 0.4\n'
    for _ in range(20):
        text = broken(random_, study).decode(errors="replace")
        status, _, answer = client.ask("POST", "/api/write_study", json.dumps({"text": text}).encode())
        assert status in (200, 400), (text, answer[:300])
        assert client.ask("GET", "/api/state")[0] == 200, text
    client.call("forget_frames", folder="frames")
    client.call("forget_frames", folder="board")
    assert outside(around) == before
    assert "Traceback" not in capfd.readouterr().err


def hostile_files(part):
    """Names and contents of files that would break a reader."""
    random_ = random.Random(7)
    yield "included.inp", b"*NODE\n1, 0, 0, 0\n*INCLUDE, INPUT=../secret.txt\n"
    yield "spaced.inp", b"*NODE\n 1,0,0,0\n  * include , input = ../secret.txt\n"
    yield "bomb.stl", b"x" * 80 + struct.pack("<I", 2**32 - 1) + bytes(50)
    yield "bomb.ply", b"ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n"
    yield (
        "entities.vtu",
        (
            b'<?xml version="1.0"?><!DOCTYPE z [<!ENTITY a "aaaaaaaaaa">'
            + b"".join(b'<!ENTITY %c "%s">' % (k + 1, b"&%c;" % k * 10) for k in range(97, 106))
            + b']><VTKFile type="UnstructuredGrid">&j;</VTKFile>'
        ),
    )
    yield (
        "external.vtu",
        b'<!DOCTYPE z [<!ENTITY s SYSTEM "../secret.txt">]><VTKFile type="UnstructuredGrid">&s;</VTKFile>',
    )
    yield "nested.vtu", b"<a>" * 100_000
    yield (
        "huge.msh",
        b"$MeshFormat\n4.1 1 8\n"
        + struct.pack("<i", 1)
        + b"\n$EndMeshFormat\n$Nodes\n"
        + b"\xff" * 32
        + b"\n$EndNodes\n",
    )
    yield "endless.inp", b"*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4\n*NSET, NSET=a, GENERATE\n1, 99999999999, 1\n"
    yield "packed.obj", gzip.compress(b"v 0 0 0\n" * 100_000)
    for number in range(40):
        broken = bytearray(part[: random_.randrange(1, len(part))])
        for _ in range(random_.randrange(30)):
            broken[random_.randrange(len(broken))] = random_.randrange(256)
        yield f"broken{number}.inp", bytes(broken)


def test_hostile_meshes_are_refused_with_a_message(studio, capfd):
    client, around = studio
    before, refused = outside(around), 0
    for name, content in hostile_files((around / "part.inp").read_bytes()):
        status, _, answer = client.ask("PUT", f"/api/upload/object/{name}", content)
        if status == 200:
            arguments = {"file": name, "unit": "mm"}
            status, _, answer = client.ask("POST", "/api/load_object", json.dumps(arguments).encode())
        assert status in (200, 400), (name, answer[:300])
        assert b"only for the owner" not in answer
        assert b"Traceback" not in answer
        refused += status == 400
        assert status == 400 or name.startswith("broken"), name
    assert refused > 40
    assert outside(around) == before
    assert "Traceback" not in capfd.readouterr().err
    assert client.call("load_object", file="part.inp", unit="mm")["n_cells"] == 54


def test_hostile_pictures_and_cameras_are_refused(studio):
    client, _ = studio
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 2**31 - 1, 2**31 - 1, 8, 2, 0, 0, 0) + bytes(4)
    before = client.state()["camera"]
    client.call("forget_frames", folder="frames")
    assert client.upload("frame", "000.png", png) in (200, 400)
    assert client.ask("GET", "/api/frame/0")[0] == 400
    for text in (
        b"width: 1e400",
        b"a: &a [*a, *a]",
        b"!!python/object/apply:os.system [id]",
        b"\xff\xfe",
        b"[" * 10_000,
    ):
        assert client.upload("camera", "camera.yaml", text) == 400
    assert client.upload("recording", "video.mp4", b"\x00" * 4096) == 400
    assert client.state()["camera"] == before


@pytest.mark.slow
def test_a_study_cannot_name_files_outside(studio):
    client, around = studio
    before = outside(around)
    for text in (
        'a = "../secret.txt"', '[materials.a]\nlaw = "user_material"\nfunction = "../code.py:energy"', 'a = ["~/x"]',
        '[[shape]]\nfile = "/etc/passwd"', "a = " + "[" * 5000, "a" * 600_000,
    ):  # fmt: skip
        assert client.ask("POST", "/api/write_study", json.dumps({"text": text}).encode())[0] == 400
    assert outside(around) == before
    assert not any("secret" in path.read_text(errors="ignore") for path in Path(around / "project").glob("*.toml"))
