"""How the studio is asked, what it tells its pages by itself, and the process that reads files."""

import asyncio
import http.client
import json
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from morph_dslam import save_model
from morph_dslam.errors import StudioError
from morph_dslam.io.access import ServerNames
from morph_dslam.studio.clicks import overlay
from morph_dslam.studio.project import Project
from morph_dslam.studio.run_files import FrameLog, log_overlay, logged_frames
from morph_dslam.studio.server import StudioServer
from morph_dslam.studio.steps import Steps
from tests.support.stretched_block import stretched_block_model

#: Starts the process that reads files, says its number, and is killed.
KILLED = """
import asyncio, os, signal
from morph_dslam.studio.worker import Worker

if __name__ == "__main__":
    print(asyncio.run(Worker().call(os.getpid)), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("name", ["DESKTOP-7F3", "desktop-7f3", "Desktop-7F3"])
def test_a_computer_is_asked_by_its_name_in_any_case(name):
    names = ServerNames(("DESKTOP-7F3",))
    assert names.refusal(f"{name}:8766", None) is None
    assert names.refusal(f"{name}:8766", f"http://{name}:8766") is None
    assert names.refusal(f"{name}.example:8766", None) is not None


def has_ipv6():
    """Whether this computer has an IPv6 address of its own."""
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


@pytest.mark.skipif(not has_ipv6(), reason="this computer has no IPv6")
def test_an_ipv6_address_is_served(tmp_path):
    server = StudioServer(tmp_path / "project", 0, "::1")
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    assert server.address == f"http://[::1]:{server.port}/?token={server.token}"
    connection = http.client.HTTPConnection("::1", server.port, timeout=30)
    connection.request("GET", f"/?token={server.token}", headers={"Host": f"[::1]:{server.port}"})
    assert connection.getresponse().status == 303
    connection.close()
    server.stop()
    thread.join(30)


def test_pages_are_told_of_another_address_for_phones(tmp_path):
    addresses = ["https://a/?token=1"]
    steps = Steps(Project(tmp_path), lambda: addresses[-1])

    async def first():
        news = steps.news()
        asyncio.get_running_loop().call_later(0.05, addresses.append, "https://a/?token=2")
        return await asyncio.wait_for(anext(news), 20)

    assert asyncio.run(first()) == ("phone", "https://a/?token=2")


def test_a_damaged_line_of_a_frame_log_is_left_out(tmp_path):
    path = tmp_path / "track.jsonl"
    path.write_text('{"frame": 0}\n{"fra\n[]\n\xff\n{"frame": 2}\n', encoding="latin-1")
    log = FrameLog(path)
    assert log.new() == [{"anew": True, "frames": [{"frame": 0}, {"frame": 2}]}]
    with path.open("a") as file:
        file.write('{"frame": 3}\n{"frame"')
    assert log.new() == [{"anew": False, "frames": [{"frame": 3}]}]
    assert log.new() == []
    assert logged_frames(path) == [{"frame": 0}, {"frame": 2}, {"frame": 3}]
    assert logged_frames(tmp_path / "none.jsonl") == []


def test_a_long_frame_log_comes_in_parts(tmp_path):
    path, numbers = tmp_path / "track.jsonl", list(range(2500))
    path.write_text("".join(f'{{"frame": {number}}}\n' for number in numbers))
    parts = FrameLog(path).new()
    assert [row["frame"] for part in parts for row in part["frames"]] == numbers
    assert max(len(part["frames"]) for part in parts) <= 1000
    assert [part["anew"] for part in parts] == [True, False, False]
    path.write_text("")
    assert FrameLog(path).new() == []


def test_the_overlay_of_a_frame_log_is_that_of_its_frame(tmp_path):
    model, camera, log = tmp_path / "model.morph", tmp_path / "camera.yaml", tmp_path / "track.jsonl"
    block = stretched_block_model()
    save_model(model, block)
    camera.write_text("width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\n")
    poses = {number: np.eye(4) for number in (7, 17, 71)}
    for number, pose in poses.items():
        pose[:3, 3] = 1e-3 * number, 0.0, 0.5
    names = [parameter.name for parameter in block.study_parameters]
    rows = [
        {"frame": number, "parameters": dict.fromkeys(names, 0.0), "camera_from_object": pose.tolist()}
        for number, pose in poses.items()
    ]
    log.write_text("".join(json.dumps(row) + "\n" for row in rows))
    for number, pose in poses.items():
        assert log_overlay(log, model, camera, number) == overlay(model, camera, [0.0] * len(names), pose.tolist())
    for number in (1, 8):
        with pytest.raises(StudioError):
            log_overlay(log, model, camera, number)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="this system tells otherwise which processes run")
def test_the_process_that_reads_files_ends_with_a_studio_that_is_killed(tmp_path):
    (tmp_path / "killed.py").write_text(KILLED)
    run = subprocess.run([sys.executable, "killed.py"], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    status = f"/proc/{int(run.stdout)}/stat"
    end = time.monotonic() + 30
    while is_running(status):
        assert time.monotonic() < end
        time.sleep(0.05)


def is_running(status):
    """Whether a process runs, by its file of status; one that has ended may wait for nobody to ask."""
    try:
        with open(status) as file:
            return file.read().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False
