"""zenoh: how sessions are opened, how keys are built, what stands beside a sample.

Sessions meet only by the endpoints that they are told: no multicast, no gossip, so that neither vehicles
nor tests find each other by accident. All keys of DESIGN 6 are built here, from names that were checked.
"""

import ipaddress
import json
import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias
from urllib.parse import quote, unquote

import zenoh

from monitor.rig_document import NAME, nearest
from pipeline.errors import RigError, TransportError

ROOT = "calibwatch"
"""First chunk of what the monitor says."""
REPLAY_ROOT = "calibwatch-replay"
"""First chunk of recordings that are replayed; a root of its own, for a vehicle may be called anything."""
COMMANDS = ("acknowledge", "snapshot", "accept", "reload")

PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws", "unixsock-stream")
_ENDPOINT = re.compile(r"([a-z-]+)/([^/\s#?].*)")
_NEVER_IN_KEYS = re.compile(r"[*$?#]|//|^/|/$|^$")

Mode: TypeAlias = Literal["client", "peer", "router"]
Leaf: TypeAlias = Literal["status", "candidate", "evidence"]
"""What is said of a pair."""
Command: TypeAlias = Literal["acknowledge", "snapshot", "accept", "reload"]


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Identity for mutual TLS.

    Attributes:
        root_ca: Certificate of the authority that both sides trust, PEM.
        key: Own private key, PEM.
        certificate: Own certificate, PEM.
    """

    root_ca: Path
    key: Path
    certificate: Path


@dataclass(frozen=True, slots=True)
class BusSettings:
    """How to reach the bus.

    Attributes:
        mode: "client" of a router, "peer", or "router" for others.
        connect: Endpoints to connect to, as in "tcp/127.0.0.1:7447"; one of them must answer.
        listen: Endpoints to listen on; "tcp/127.0.0.1:0" takes a free port (:func:`listening_at`).
        timeout_s: How long opening may take, s.
        tls: Identity for tls endpoints, or None.
    """

    mode: Mode = "client"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    timeout_s: float = 2.0
    tls: TlsFiles | None = None


def open_session(settings: BusSettings) -> zenoh.Session:
    """Opens a session. Use it with ``with``: one that is left open can hang the interpreter at exit.

    Raises:
        RigError: An endpoint or the identity is not usable as it is written.
        TransportError: Nobody answers, or refuses (the transport does not tell which), or the port is taken.
    """
    config = _config(settings)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        if settings.connect:
            hint = "is the router up, and, for tls, are certificate, name and authority those it trusts?"
            what = f"no session with {', '.join(settings.connect)} within {settings.timeout_s:g} s"
        else:
            hint = "is the port free, and the address one of this machine?"
            what = f"can not listen on {', '.join(settings.listen)}"
        raise TransportError(what, hint=hint) from error


def command_refusal(settings: BusSettings, *, allowed: bool) -> str | None:
    """Why nobody may command over a session of these settings; None where who reaches it may.

    Who can reach a session that meets others on this machine alone, or that asks them for an identity, may;
    a router passes on what it is told, so a session that connects to one is not closed to others.
    """
    endpoints = (*settings.connect, *settings.listen)
    at_home = not settings.connect and all(_is_loopback(endpoint) for endpoint in settings.listen)
    known = settings.tls is not None and all(endpoint.startswith(_IDENTIFIED) for endpoint in endpoints)
    if allowed or at_home or known:
        return None
    return "commands are refused, for others may reach this bus: start the watch with --allow-commands"


_IDENTIFIED = ("tls/", "quic/")
"""Protocols at which both sides prove who they are."""


def _is_loopback(endpoint: str) -> bool:
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream":
        return True
    host = re.split(r"[?#]", address)[0].rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def listening_at(session: zenoh.Session) -> tuple[str, ...]:
    """The endpoints at which a session listens, with the ports that it got."""
    found: list[str] = []
    for reply in session.get(f"@/{session.zid()}/*", timeout=2.0):
        sample = reply.ok
        if sample is not None:
            described = json.loads(sample.payload.to_bytes())
            found += [locator for locator in described.get("locators", []) if isinstance(locator, str)]
    return tuple(found)


def _config(settings: BusSettings) -> zenoh.Config:
    for endpoint in (*settings.connect, *settings.listen):
        _check_endpoint(endpoint)
    if settings.mode == "client" and not settings.connect:
        raise RigError("mode client has no endpoint to connect to", hint="connect = ['tcp/127.0.0.1:7447']")
    document: dict[str, object] = {
        "mode": settings.mode,
        # The delay would hold back every opening by half a second, to wait for scouting that is off.
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "listen": {"endpoints": list(settings.listen)},
        "connect": {
            "endpoints": list(settings.connect),
            "timeout_ms": round(settings.timeout_s * 1000),
            "exit_on_failure": True,
        },
        # Publishers with a cache refuse to exist without.
        "timestamping": {"enabled": {"client": True, "peer": True, "router": True}},
        # Read only: the session tells its own endpoints.
        "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
    }
    if settings.tls is not None:
        document["transport"] = {"link": {"tls": _tls(settings.tls)}}
    try:
        return zenoh.Config.from_json5(json.dumps(document))
    except zenoh.ZError as error:
        raise RigError(
            "the settings of the bus are refused by zenoh",
            hint="check the endpoints and the files of the identity",
        ) from error


def _tls(files: TlsFiles) -> dict[str, object]:
    for path in (files.root_ca, files.key, files.certificate):
        if not os.access(path, os.R_OK):
            raise RigError(
                f"{path} can not be read", hint="tls wants root_ca, key and certificate as PEM files"
            )
    return {
        "root_ca_certificate": str(files.root_ca),
        "listen_private_key": str(files.key),
        "listen_certificate": str(files.certificate),
        "connect_private_key": str(files.key),
        "connect_certificate": str(files.certificate),
        "enable_mtls": True,
        "verify_name_on_connect": True,
    }


def _check_endpoint(endpoint: str) -> None:
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None:
        raise RigError(f"'{endpoint}' is no endpoint", hint="as in tcp/127.0.0.1:7447")
    if match[1] not in PROTOCOLS:
        raise RigError(f"'{endpoint}': protocol '{match[1]}' is not known", hint=nearest(match[1], PROTOCOLS))


def pair_key(vehicle: str, pair: str, leaf: Leaf) -> str:
    """``calibwatch/<vehicle>/<pair>/<leaf>``; the names are checked."""
    return f"{ROOT}/{_name(vehicle)}/{_name(pair)}/{leaf}"


def every_pair_key(vehicle: str, leaf: Leaf) -> str:
    """``calibwatch/<vehicle>/*/<leaf>``, the key expression of all pairs."""
    return f"{ROOT}/{_name(vehicle)}/*/{leaf}"


def command_key(vehicle: str, pair: str, command: Command) -> str:
    """``calibwatch/<vehicle>/<pair>/cmd/<command>``."""
    if command not in COMMANDS:
        raise RigError(f"'{command}' is no command", hint=nearest(command, COMMANDS))
    return f"{ROOT}/{_name(vehicle)}/{_name(pair)}/cmd/{command}"


def alive_key(vehicle: str) -> str:
    """``calibwatch/<vehicle>/alive``, the liveliness token."""
    return f"{ROOT}/{_name(vehicle)}/alive"


def replay_prefix(run: str) -> str:
    """``calibwatch-replay/<run>``: below it lie ``feed/*``, ``ack`` and the tokens ``reader``, ``writer``."""
    return f"{REPLAY_ROOT}/{_name(run)}"


def replay_key(run: str, topic: str) -> str:
    """The key of a topic of a replayed recording: one percent-encoded chunk, so that the topic comes back."""
    return f"{replay_prefix(run)}/feed/topic/{quote(topic, safe='')}"


def replayed_topic(key: str) -> str:
    """The topic of :func:`replay_key`."""
    return unquote(key.rsplit("/", 1)[-1])


def keys_of(topic: str) -> tuple[str, ...]:
    """Key expressions under which a topic of the rig comes.

    A ROS topic (it starts with "/") comes as rmw_zenoh names it, ``<domain>/<topic>/<type>/<hash>`` with
    any domain, type and hash, and as zenoh-bridge-ros2dds names it, without slash; anything else is a key
    expression.

    Raises:
        RigError: It makes no key expression.
    """
    if not topic.startswith("/"):
        try:
            zenoh.KeyExpr(topic)
        except zenoh.ZError as error:
            raise RigError(
                f"'{topic}' is no key expression", hint="as in vehicle/lidar/* or /lidar/points"
            ) from error
        return (topic,)
    name = topic[1:]
    if _NEVER_IN_KEYS.search(name):
        raise RigError(f"'{topic}' is no ROS topic", hint="as in /lidar/points")
    return (f"*/{name}/*/*", name)


def rmw_type(key: str) -> str | None:
    """The type in a key of rmw_zenoh, as ``pkg/msg/Name``; None where the key has none."""
    chunks = key.split("/")
    if len(chunks) < 4 or "::dds_::" not in chunks[-2]:
        return None
    return chunks[-2].replace("::dds_::", "/").replace("::", "/").removesuffix("_")


def _name(name: str) -> str:
    if not NAME.fullmatch(name):
        raise RigError(f"'{name}' can not be part of a key", hint=f"names match {NAME.pattern}")
    return name


_SHORT = struct.Struct("<qqB16s")
"""Attachment of rmw_zenoh: sequence number, source time ns, length 16, gid."""
_LONG = struct.Struct("<B15sqB16sqB10sB16s")
"""Attachment of its first releases for Jazzy: each field after its own name."""
_LONG_NAMES = (b"sequence_number", b"source_timestamp", b"source_gid")


@dataclass(frozen=True, slots=True)
class Origin:
    """What a publisher says beside a sample.

    Attributes:
        sequence: Its running number.
        source_ns: Its time when it published, ns.
        gid: Who it is, 16 bytes.
    """

    sequence: int
    source_ns: int
    gid: bytes

    def to_bytes(self) -> bytes:
        """The 33 bytes that rmw_zenoh reads."""
        return _SHORT.pack(self.sequence, self.source_ns, 16, self.gid)


def origin(attachment: bytes) -> Origin | None:
    """The attachment of rmw_zenoh, either layout; None where it is neither."""
    if len(attachment) == _SHORT.size:
        sequence, source_ns, length, gid = _SHORT.unpack(attachment)
        return Origin(sequence, source_ns, gid) if length == 16 else None
    if len(attachment) == _LONG.size:
        _, name1, sequence, _, name2, source_ns, _, name3, _, gid = _LONG.unpack(attachment)
        return Origin(sequence, source_ns, gid) if (name1, name2, name3) == _LONG_NAMES else None
    return None
