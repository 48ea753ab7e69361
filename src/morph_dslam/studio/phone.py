"""A phone as the camera: a page over HTTPS that records, and hands the video to the project.

Browsers give a camera to pages over HTTPS alone, so the studio makes a certificate of its own, of which the phone
warns. The phone is let in by a token that works once, and can do nothing but bring a recording.
"""

from __future__ import annotations

import datetime
import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import uvicorn
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from morph_dslam.studio.live import WEBSOCKETS

#: Days that a certificate holds; a new one is made at each start.
_DAYS = 7
#: Modules of white around a QR code, and pixels of one module.
_MARGIN, _SCALE = 2, 5


def own_address() -> str:
    """The address by which others in the network reach this computer; its own where there is no network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # nothing is sent: the system only chooses the way
        except OSError:
            return "127.0.0.1"
        return str(probe.getsockname()[0])


def write_certificate(folder: Path, address: str) -> tuple[Path, Path]:
    """Write a certificate for an address of this computer, signed by itself, and its key; returns both files."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "morph studio")])
    now = datetime.datetime.now(datetime.UTC)
    names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(address)), x509.DNSName("localhost")])
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number()).add_extension(names, critical=False)
    builder = builder.not_valid_before(now).not_valid_after(now + datetime.timedelta(days=_DAYS))
    encoding = serialization.Encoding.PEM
    certificate, private = folder / "certificate.pem", folder / "key.pem"
    certificate.write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(encoding))
    private.touch(mode=0o600)
    plain = serialization.NoEncryption()
    private.write_bytes(key.private_bytes(encoding, serialization.PrivateFormat.PKCS8, plain))
    return certificate, private


def qr_code(text: str) -> bytes:
    """A text as a QR code with a white margin, PNG."""
    code = cv2.QRCodeEncoder.create().encode(text)
    framed = np.pad(np.asarray(code), _MARGIN, constant_values=255)
    large = np.ascontiguousarray(np.kron(framed, np.ones((_SCALE, _SCALE), np.uint8)))
    return cv2.imencode(".png", large)[1].tobytes()


class PhoneServer(uvicorn.Server):
    """A server for phones, which runs beside that of the pages and ends with it.

    Parameters
    ----------
    application : that answers.
    address : of this computer, for the certificate.
    """

    def __init__(self, application, address: str) -> None:
        with TemporaryDirectory() as folder:
            certificate, key = write_certificate(Path(folder), address)
            config = uvicorn.Config(
                application, log_level="critical", access_log=False, server_header=False, lifespan="off", **WEBSOCKETS,
                ssl_certfile=certificate, ssl_keyfile=key, timeout_graceful_shutdown=2,
            )  # fmt: skip
            config.load()  # reads the certificate, whose files are then gone
        super().__init__(config)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals to the server of the pages."""
        yield
