"""A studio at a port of its own, and a part that goes through all of its steps."""

from __future__ import annotations

import http.client
import json
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar
from unittest.mock import patch

import numpy as np

from morph_dslam.extend.mechanics import block, save_mesh
from morph_dslam.studio.server import StudioServer
from tests.support.scenes import write_texture

#: Size of the part, millimetres.
SIZE = (40, 40, 80)
#: A film of the part, whose head is pushed sideways.
SCENE = """
model = "model.morph"
image_format = "png"
frames = 8
camera = { width = 480, height = 360, fx = 430.0, fy = 430.0, cx = 239.5, cy = 179.5 }
[surface]
texture = "print.png"
[[parameters]]
frame = 0
push = 0.0
[[parameters]]
frame = 7
push = 9.0
[[pose]]
frame = 0
position_mm = [-10, 45, 200]
rotation_deg = [110, 0, 25]
[[pose]]
frame = 7
position_mm = [0, 45, 195]
rotation_deg = [112, 4, 29]
"""


def write_part(path):
    """A block of hexahedra without any named set, as .inp in millimetres."""
    mesh = block(tuple(1e-3 * length for length in SIZE), (3, 3, 6), "hex8")
    save_mesh(path, replace(mesh, surfaces={}, node_sets={}), "mm")


def write_scene(folder):
    """The scene file of a film of ``model.morph`` in a folder; returns its path."""
    write_texture(folder)
    (folder / "scene.toml").write_text(SCENE)
    return folder / "scene.toml"


class TakenOver:
    """In place of the process that reads the files of a studio: one that the next studio takes over.

    To start one takes longer than most tests of a studio. A studio that replaces it, as its process has died, has an
    own one from then on.
    """

    options: ClassVar[dict[str, Any]] = {}
    kept: ClassVar[ProcessPoolExecutor | None] = None

    def __init__(self, count, **options):
        type(self).options = {"max_workers": count, **options}
        self._of_all = self.kept is not None
        self._pool = self.kept if self._of_all else ProcessPoolExecutor(**self.options)

    @classmethod
    def start(cls):
        """Start the process before the studio does, which ends what it has started."""
        if cls.options and cls.kept is None:
            cls.kept = ProcessPoolExecutor(**cls.options)
            cls.kept.submit(int)

    def submit(self, function, *arguments):
        self._last = self._pool.submit(function, *arguments)
        return self._last

    def shutdown(self, **options):
        last = self._last
        works = last.done() and not last.cancelled() and not isinstance(last.exception(), BrokenProcessPool)
        if self._of_all and works:
            return
        if self._of_all:
            type(self).kept = None
        self._pool.shutdown(**options)


@contextmanager
def running_studio(folder, phone=False, takes_over=True):
    """A studio that answers as long as the context lasts; unless it ``takes_over`` a process, it has an own one."""
    if takes_over:
        TakenOver.start()
    with patch("morph_dslam.studio.worker.ProcessPoolExecutor", TakenOver if takes_over else ProcessPoolExecutor):
        server = StudioServer(folder, port=0, phone=phone)
        thread = threading.Thread(target=server.run, daemon=True)
        thread.start()
        end = time.monotonic() + 30
        while not server.started:
            assert time.monotonic() < end
            time.sleep(0.01)
        try:
            yield server
        finally:
            server.stop()
            thread.join(30)
            assert not thread.is_alive()


class Client:
    """What a page of a studio does, without a browser.

    Parameters
    ----------
    server : that is asked.
    """

    def __init__(self, server):
        self._server, self.port = server, server.port
        self.own = {
            "Host": f"127.0.0.1:{server.port}",
            "Cookie": f"morph_studio_{server.port}={server.token}",
            "Origin": f"http://127.0.0.1:{server.port}",
        }

    def ask(self, method, path, body=None, **headers):
        """Status, headers and content of an answer; a header that is None is left out."""
        connection = http.client.HTTPConnection("127.0.0.1", self._server.port, timeout=300)
        sent = {name: value for name, value in (self.own | headers).items() if value is not None}
        try:
            connection.putrequest(method, path, skip_host=True)
            for name, value in (sent | {"Content-Length": str(len(body or b""))}).items():
                connection.putheader(name, value)
            connection.endheaders(body or None)
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    def refused(self, action, **arguments):
        """The message of an action that is refused."""
        status, _, content = self.ask("POST", f"/api/{action}", json.dumps(arguments).encode())
        assert status == 400, content
        return content.decode()

    def call(self, action, **arguments):
        """What an action answers: JSON, or facts with arrays."""
        status, headers, content = self.ask("POST", f"/api/{action}", json.dumps(arguments).encode())
        assert status == 200, content
        return json.loads(content) if headers["content-type"] == "application/json" else unpacked(content)

    def upload(self, kind, name, content):
        """Upload a file; returns the status."""
        return self.ask("PUT", f"/api/upload/{kind}/{name}", content)[0]

    def state(self):
        """The state of the project."""
        return json.loads(self.ask("GET", "/api/state")[2])

    def events(self, until):
        """Server-sent events (name, content) up to the first for which ``until`` is true."""
        connection = http.client.HTTPConnection("127.0.0.1", self._server.port, timeout=300)
        connection.request("GET", "/api/events", headers=self.own)
        answer, found = connection.getresponse(), []
        try:
            while not found or not until(*found[-1]):
                name, data = (answer.readline().decode().strip().partition(": ")[2] for _ in range(2))
                answer.readline()
                found.append((name, json.loads(data)))
        finally:
            answer.close()
            connection.close()
        return found


def unpacked(content):
    """Facts, and the arrays that they list."""
    start = 4 + int.from_bytes(content[:4], "little")
    facts = json.loads(content[4:start])
    for name, kind, size in facts["arrays"]:
        facts[name] = np.frombuffer(content, kind, size, start)
        start += 4 * size
    assert start == len(content)
    return facts
