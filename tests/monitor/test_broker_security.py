"""A broker that asks for TLS, a user and a password: only who has all of them right gets through, and no log tells."""

from __future__ import annotations

import datetime
import ipaddress
import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt import publish, subscribe
from paho.mqtt.enums import MQTTProtocolVersion

from .plant import LINES, Running, by_broker, rows_of, until
from .servers import MOSQUITTO, Broker

x509 = pytest.importorskip("cryptography.x509", reason="cryptography is not installed")
PASSWD = shutil.which("mosquitto_passwd")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(MOSQUITTO is None or PASSWD is None, reason="mosquitto is not installed"),
]
SECRET = "correct horse"
GUARDED = """
user = "monitor"
password_file = "../{password}"
tls = true
ca_file = "../{ca}.pem"
"""


def signed(folder: Path, name: str, by: Any = None) -> tuple[Any, Any]:
    """A certificate of this machine and its key, signed by an authority, or an authority; files NAME.pem, NAME.key."""
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    issuer, signing = by or (None, key)
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    built = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if issuer is None else issuer.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=issuer is None, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), critical=False)
    )
    certificate = built.sign(signing, hashes.SHA256())
    pem = serialization.Encoding.PEM
    plain = (serialization.PrivateFormat.TraditionalOpenSSL, serialization.NoEncryption())
    (folder / f"{name}.pem").write_bytes(certificate.public_bytes(pem))
    (folder / f"{name}.key").write_bytes(key.private_bytes(pem, *plain))
    return certificate, key


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[Broker]:
    authority = signed(tmp_path, "authority")
    signed(tmp_path, "broker", authority)
    signed(tmp_path, "another")
    subprocess.run([str(PASSWD), "-b", "-c", str(tmp_path / "users"), "monitor", SECRET], check=True)
    guards = [f"cafile {tmp_path}/authority.pem", f"certfile {tmp_path}/broker.pem", f"keyfile {tmp_path}/broker.key"]
    broker = Broker(tmp_path, "\n".join([*guards, "allow_anonymous false", f"password_file {tmp_path}/users"]))
    yield broker
    broker.stop()


def test_tls_user_and_password_open_the_broker_and_nothing_less(undisturbed, guarded: Broker, tmp_path: Path, caplog):
    (tmp_path / "right").write_text(SECRET + "\n")
    (tmp_path / "wrong").write_text("battery staple\n")

    def running(folder: str, ca: str = "authority", password: str = "right") -> Running:
        (tmp_path / folder).mkdir()
        return Running(by_broker(tmp_path / folder, guarded.port, GUARDED.format(password=password, ca=ca)))

    for folder, options, reason in (
        ("ca", {"ca": "another"}, f"no connection to 127.0.0.1:{guarded.port}: its certificate is not trusted"),
        ("password", {"password": "wrong"}, "127.0.0.1 refuses the connection: Not authorized"),
    ):
        refused = running(folder, **options)
        until(lambda of=refused: of.service.supervisor.outages())
        (outage,) = refused.service.supervisor.outages()
        refused.end()
        assert outage["reason"].startswith(reason)
        assert refused.service.actuators.counters == {}
    let_in = running("open")
    until(lambda: let_in.service.supervisor.outage_totals().get("broker", (False,))[0])
    entry = {
        "hostname": "127.0.0.1",
        "port": guarded.port,
        "protocol": MQTTProtocolVersion.MQTTv5,
        "auth": {"username": "monitor", "password": SECRET},
        "tls": {"ca_certs": str(tmp_path / "authority.pem")},
    }
    lines = LINES.splitlines()
    topics = [f"plant/{json.loads(line)['actuator']}" for line in lines]
    publish.multiple(
        [{"topic": topic, "payload": line, "qos": 1} for topic, line in zip(topics, lines, strict=True)], **entry
    )
    let_in.until(len(lines))
    until(lambda: let_in.service.store.position("mqtt") > 0)
    let_in.end()
    retained = subscribe.simple("sealscope/press 1/alarm", **entry)
    assert json.loads(retained.payload)["id"] == "press 1-1"
    ours = rows_of(let_in.service.settings.database)
    assert (ours["estimates"], ours["blocks"]) == (undisturbed["estimates"], undisturbed["blocks"])
    assert SECRET not in caplog.text and "staple" not in caplog.text
