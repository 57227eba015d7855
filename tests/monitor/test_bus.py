"""Sessions, keys and attachments, on real sessions over the loopback."""

import shutil
import struct
import subprocess

import pytest
import zenoh
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st

from monitor import bus
from monitor.bus import BusSettings, Origin, open_session, origin
from pipeline.errors import RigError, TransportError

GID = bytes(range(16))


def test_two_sessions_meet_by_endpoint_alone():
    with open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))) as a:
        (endpoint,) = bus.listening_at(a)
        assert endpoint.startswith("tcp/127.0.0.1:")
        with (
            open_session(BusSettings(mode="client", connect=(endpoint,))) as b,
            a.declare_subscriber("k") as heard,
        ):
            b.put("k", b"hello")
            assert heard.recv().payload.to_bytes() == b"hello"


def test_a_router_in_python_routes_between_clients():
    with open_session(BusSettings(mode="router", listen=("tcp/127.0.0.1:0",))) as hub:
        settings = BusSettings(connect=bus.listening_at(hub))
        with open_session(settings) as a, open_session(settings) as b, a.declare_subscriber("x/*") as heard:
            # The router may learn of the subscription after the first put: publish until it is heard.
            while (sample := heard.try_recv()) is None:
                b.put("x/y", b"1")
            assert str(sample.key_expr) == "x/y"


def test_nobody_at_the_endpoint():
    with pytest.raises(TransportError, match=r"no session with tcp/127.0.0.1:1 within 0.2 s") as caught:
        open_session(BusSettings(connect=("tcp/127.0.0.1:1",), timeout_s=0.2))
    assert ".rs" not in str(caught.value)


def test_a_port_that_is_taken():
    with open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))) as a:
        taken = bus.listening_at(a)
        with pytest.raises(TransportError, match="can not listen on"):
            open_session(BusSettings(mode="peer", listen=taken))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (BusSettings(connect=("tpc/127.0.0.1:1",)), "protocol 'tpc'.*did you mean 'tcp'"),
        (BusSettings(connect=("127.0.0.1:7447",)), "is no endpoint"),
        (BusSettings(), "no endpoint to connect to"),
    ],
)
def test_settings_that_are_refused(settings, words):
    with pytest.raises(RigError, match=words):
        open_session(settings)


def test_tls_files_that_are_absent(tmp_path):
    files = bus.TlsFiles(tmp_path / "ca.pem", tmp_path / "key.pem", tmp_path / "cert.pem")
    with pytest.raises(RigError, match=r"ca.pem can not be read"):
        open_session(BusSettings(connect=("tls/127.0.0.1:1",), tls=files))


OPENSSL = shutil.which("openssl")


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """An authority, two identities that it signed, and a stranger who calls himself like one of them."""
    if OPENSSL is None:
        pytest.skip("no openssl to make certificates with")
    at = tmp_path_factory.mktemp("tls")
    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"]

    def run(*arguments):
        subprocess.run([OPENSSL, *arguments], cwd=at, check=True, capture_output=True)  # noqa: S603 - as above

    run("req", "-x509", *key, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=authority")
    run("req", "-x509", *key, "-keyout", "stranger.key", "-out", "stranger.pem", "-subj", "/CN=van")
    (at / "names").write_text("subjectAltName=DNS:localhost\n")
    for name in ("hub", "van"):
        run("req", *key[:-2], "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        signing = ["-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-extfile", "names"]
        run("x509", "-req", "-in", f"{name}.csr", *signing, "-out", f"{name}.pem")
    return {
        name: bus.TlsFiles(at / "ca.pem", at / f"{name}.key", at / f"{name}.pem")
        for name in ("hub", "van", "stranger")
    }


def test_mutual_tls_lets_in_whom_the_authority_signed_and_nobody_else(certificates):
    hub_settings = BusSettings(mode="router", listen=("tls/127.0.0.1:0",), tls=certificates["hub"])
    with open_session(hub_settings) as hub:
        endpoint = bus.listening_at(hub)[0].replace("127.0.0.1", "localhost")
        with open_session(BusSettings(connect=(endpoint,), tls=certificates["van"])) as session:
            assert [link.auth_identifier for link in session.info.links()] == ["hub"]
        for tls in (certificates["stranger"], None):
            with pytest.raises(TransportError, match="no session with tls/localhost"):
                open_session(BusSettings(connect=(endpoint,), tls=tls, timeout_s=0.5))


def test_keys_of_the_specification():
    assert bus.pair_key("van-17", "front", "status") == "calibwatch/van-17/front/status"
    assert bus.every_pair_key("van-17", "status") == "calibwatch/van-17/*/status"
    assert bus.command_key("van-17", "front", "accept") == "calibwatch/van-17/front/cmd/accept"
    assert bus.alive_key("van-17") == "calibwatch/van-17/alive"


@pytest.mark.parametrize("name", ["", "a/b", "*", "**", "a b", "x" * 65, "ä", "a\n", "@x", "a#", "$*"])
def test_names_that_would_break_a_key(name):
    for build in (
        lambda: bus.alive_key(name),
        lambda: bus.pair_key("v", name, "status"),
        lambda: bus.every_pair_key(name, "candidate"),
        lambda: bus.replay_prefix(name),
    ):
        with pytest.raises(RigError, match="can not be part of a key"):
            build()


def test_an_unknown_command():
    with pytest.raises(RigError, match="did you mean 'accept'"):
        bus.command_key("v", "p", "acept")


@given(
    st.text(min_size=1).filter(
        lambda text: "\0" not in text and text.encode("utf-8", "ignore").decode() == text
    )
)
def test_a_replayed_topic_comes_back_whatever_it_contains(topic):
    key = bus.replay_key("run", topic)
    assert zenoh.KeyExpr("calibwatch-replay/run/feed/topic/*").includes(zenoh.KeyExpr(key))
    assert bus.replayed_topic(key) == topic


def test_a_ros_topic_is_heard_from_rmw_and_from_the_bridge():
    keys = [zenoh.KeyExpr(key) for key in bus.keys_of("/lidar/points")]
    rmw = "0/lidar/points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_9198"
    assert any(key.includes(zenoh.KeyExpr(rmw)) for key in keys)
    assert any(key.includes(zenoh.KeyExpr("lidar/points")) for key in keys)
    assert not any(key.includes(zenoh.KeyExpr("lidar/points2")) for key in keys)
    assert bus.rmw_type(rmw) == "sensor_msgs/msg/PointCloud2"
    assert bus.rmw_type("lidar/points") is None


@pytest.mark.parametrize("topic", ["/", "//a", "/a/", "/a b*", "/a#", "a//b", "", "a/", "x*"])
def test_topics_that_make_no_key(topic):
    with pytest.raises(RigError, match="is no"):
        bus.keys_of(topic)


def test_the_short_attachment_is_what_zenoh_serializes():
    raw = zenoh.ext.z_serialize((zenoh.ext.Int64(-3), zenoh.ext.Int64(1 << 60), GID)).to_bytes()
    assert Origin(-3, 1 << 60, GID).to_bytes() == raw
    assert origin(raw) == Origin(-3, 1 << 60, GID)


def test_the_long_attachment_of_the_first_jazzy_releases():
    named = zenoh.ext.z_serialize(
        ("sequence_number", zenoh.ext.Int64(7), "source_timestamp", zenoh.ext.Int64(8), "source_gid", GID)
    ).to_bytes()
    assert len(named) == 77
    assert origin(named) == Origin(7, 8, GID)


@given(st.binary(max_size=100))
def test_any_other_attachment_is_none_or_an_origin(raw):
    found = origin(raw)
    assert found is None or len(found.gid) == 16


def test_a_gid_of_another_length_is_refused():
    assert origin(struct.pack("<qqB16s", 1, 2, 15, GID)) is None
