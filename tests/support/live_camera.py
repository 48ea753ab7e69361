"""What a page does that is a live camera of the studio, or looks on, without a browser."""

from __future__ import annotations

import asyncio
import http.client
import json
import ssl
import struct
import threading
from contextlib import closing

from websockets.asyncio.client import connect

NUMBER = struct.Struct("<I")


def any_certificate():
    """Accepts a certificate that nobody else has signed."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def phone_session(server, address):
    """The cookie that a phone gets for the address that it opens, and its origin; status 401 is a PermissionError."""
    connection = http.client.HTTPSConnection("127.0.0.1", server.phone_port, timeout=30, context=any_certificate())
    with closing(connection):
        connection.request("GET", "/?" + address.partition("?")[2])
        answer = connection.getresponse()
        if answer.status != 303:
            raise PermissionError(answer.status)
        cookie = answer.getheader("set-cookie").partition(";")[0]
    return {"Cookie": cookie, "Origin": f"https://127.0.0.1:{server.phone_port}"}


class LivePage:
    """One WebSocket of a page; a context manager.

    One thread alone touches the socket: OpenSSL does not let one send while another receives.

    Parameters
    ----------
    port : of the server.
    path : "/api/camera" or "/api/watch".
    headers : cookie and origin.
    phone : whether the port is that of phones.

    Attributes
    ----------
    facts : that it was told last, by name.
    """

    def __init__(self, port, path, headers, phone=False):
        scheme, more = ("wss", {"ssl": any_certificate()}) if phone else ("ws", {})
        headers = {name: value for name, value in headers.items() if name != "Host"}  # which it sends itself
        self._connecting = connect(
            f"{scheme}://127.0.0.1:{port}{path}", additional_headers=headers, compression=None, max_size=None, **more
        )
        self.facts = {}

    def __enter__(self):
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        try:
            self._socket = self._wait(self._connecting.__aenter__())
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *problem):
        try:
            self._wait(self._connecting.__aexit__(*problem))
        finally:
            self._end()

    def _wait(self, coroutine, seconds=60.0):
        return asyncio.run_coroutine_threadsafe(asyncio.wait_for(coroutine, seconds), self._loop).result()

    def _end(self):
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def send(self, number, jpeg):
        """Send a frame."""
        self._wait(self._socket.send(NUMBER.pack(number) + jpeg))

    def say(self, message):
        """Send something that is no frame; of a list, each as a part of one message."""
        self._wait(self._socket.send(message))

    def receive(self, seconds=60.0):
        """The next message: (number, JPEG) of a picture, or None when facts came."""
        message = self._wait(self._socket.recv(), seconds)
        if isinstance(message, str):
            self.facts |= json.loads(message)
            return None
        return NUMBER.unpack_from(message)[0], message[NUMBER.size :]

    def wait_for(self, name, value, seconds=60.0):
        """Receive until a fact has a value; pictures are left out."""
        while self.facts.get(name) != value:
            self.receive(seconds)

    def picture_of(self, number, seconds=60.0):
        """Receive until the picture of a frame, or of a later one, has come; returns its JPEG."""
        while (found := self.receive(seconds)) is None or found[0] < number:
            pass
        return found[1]
