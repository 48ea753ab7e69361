"""The studio under hostile requests and files: each gets an answer, nothing leaves the folder, nothing breaks."""

import gzip
import json
import random
import struct
from pathlib import Path

import pytest

from tests.support.studio import Client, running_studio, write_part

SECRET = b"1, 0.25, 0.5, 0.75 only for the owner"
WORDS = (
    "..", "../secret.txt", "..%2fsecret.txt", "%2e%2e/secret.txt", "/etc/passwd", "~/x", ".hidden",
    "a/../../secret.txt", "link/secret.txt", "secret.txt", "study.toml", "mesh.inp", "C:\\x", "a\x00b", "\u202e",
    "x" * 5000, "-o", "--help", "frames", "board", "", " ", "{}", "null", "$(id)", "`id`", "'; drop",
    "<script>", "nan", "1e999", "-1", "part.inp",
)  # fmt: skip
ACTIONS = (
    "load_object", "grow", "name_set", "forget_set", "study", "write_study", "change_study", "forms", "model",
    "calibrate", "guess_camera", "start_files", "model_mesh", "fit", "save_start", "tracked_frames", "overlay",
    "forget_frames", "stop", "close", "__init__", "_worker",
)  # fmt: skip
ARGUMENTS = (
    "file", "unit", "size_mm", "face", "angle", "name", "faces", "text", "section", "key", "value", "board", "square",
    "lens", "photo", "pairs", "at_rest", "frame", "folder",
)  # fmt: skip
KINDS = ("object", "camera", "recording", "frame", "board", "photo", "landmarks", "secret", "..")
SUFFIXES = (".stl", ".obj", ".ply", ".inp", ".msh", ".vtu", ".vtk", ".yaml", ".mp4", ".png", ".jpg", ".csv", ".py", "")


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    """A client of a studio, its project folder, and the folder around it with a secret and a link to it."""
    around = tmp_path_factory.mktemp("hostile")
    (around / "secret.txt").write_bytes(SECRET)
    with running_studio(around / "project") as server:
        (around / "project" / "link").symlink_to(around)
        client = Client(server)
        write_part(around / "part.inp")
        assert client.upload("object", "part.inp", (around / "part.inp").read_bytes()) == 200
        yield client, around


def outside(around):
    """What lies around the project folder."""
    files = [path for path in around.rglob("*") if not path.is_relative_to(around / "project")]
    return {path: path.read_bytes() for path in files if path.is_file()}


def some_value(random_, depth=0):
    """A value that an action does not expect."""
    kind = random_.randrange(9)
    if kind == 0 and depth < 3:
        return [some_value(random_, depth + 1) for _ in range(random_.randrange(4))]
    if kind == 1 and depth < 3:
        return {random_.choice(WORDS[:12]): some_value(random_, depth + 1) for _ in range(random_.randrange(3))}
    plain = (None, True, -1, 10**30, 1e308, random_.choice(WORDS), random_.choice(WORDS), random_.choice(WORDS), "mm")
    return plain[random_.randrange(9)]


def some_request(random_):
    """Method, path, body and headers of a request."""
    kind = random_.randrange(5)
    if kind == 0:
        names = (random_.choice(WORDS).encode(errors="ignore").hex(), random_.choice(WORDS))
        name = "".join(c if c.isprintable() and c.isascii() and c != " " else "%00" for c in names[1])
        return (
            random_.choice(("GET", "GET", "DELETE", "PUT")),
            f"/{random_.choice(('files', 'explore', ''))}/{name}",
            b"",
            {},
        )
    if kind == 1:
        name = "".join(c if c.isalnum() or c in "._/%-" else "%41" for c in random_.choice(WORDS))[:300] or "x"
        body = random_.randbytes(random_.randrange(2000))
        return "PUT", f"/api/upload/{random_.choice(KINDS)}/{name}{random_.choice(SUFFIXES)}", body, {}
    if kind == 2:
        body = random_.choice(
            (b"", b"[]", b"null", b"{", b"[" * 100_000, b'{"a":' * 5000, b"NaN", b'{"frame": NaN}', b"\xff")
        )
        return "POST", f"/api/{random_.choice(ACTIONS)}", body, {}
    if kind == 3:
        headers = {
            random_.choice(("Host", "Origin", "Cookie", "Range", "Accept")): random_.choice(
                ("", "x", "null", "[", "a" * 5000)
            )
        }
        return (
            random_.choice(("GET", "POST", "HEAD", "OPTIONS", "TRACE")),
            random_.choice(("/", "/api/state", "/report")),
            b"",
            headers,
        )
    chosen = random_.sample(ARGUMENTS, random_.randrange(4))
    body = json.dumps({name: some_value(random_) for name in chosen}).encode()
    return "POST", f"/api/{random_.choice(ACTIONS)}", body, {}


def test_hostile_requests_are_answered_and_nothing_else(studio, capfd):
    client, around = studio
    before, random_ = outside(around), random.Random(19)
    statuses = set()
    for _ in range(500):
        method, path, body, headers = some_request(random_)
        status, _, content = client.ask(method, path, body, **headers)
        statuses.add(status)
        assert status < 500, (method, path, body[:200], content[:200])
        assert SECRET not in content
        assert b"Traceback" not in content
    assert {200, 400, 401, 403, 404, 405} <= statuses
    assert outside(around) == before
    assert "Traceback" not in capfd.readouterr().err
    assert client.call("forms")["laws"]


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
        assert client.upload("object", name, content) == 200
        status, _, answer = client.ask("POST", "/api/load_object", json.dumps({"file": name, "unit": "mm"}).encode())
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
    assert client.state()["camera"] is None


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
