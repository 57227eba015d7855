"""``calibwatch acknowledge``: what is refused before any watch is asked; the rest is in test_command_bus."""

import pytest

NOBODY = "tcp/127.0.0.1:9"


@pytest.fixture
def unreachable(monkeypatch):
    """A bus that must not be asked."""

    def opened(_settings):
        pytest.fail("the bus was asked")

    monkeypatch.setattr("monitor.bus.open_session", opened)


@pytest.mark.usefixtures("unreachable")
@pytest.mark.parametrize(
    ("vehicle", "pair", "told"),
    [
        ("van 17", "front", "'VEHICLE': 'van 17' is no name"),
        ("van-17", "front/left", "'PAIR': 'front/left' is no name"),
        ("*", "front", "'VEHICLE': '*' is no name"),
        ("van-17", "", "'PAIR': '' is no name"),
        ("van-17", "x" * 65, "is no name: 1 to 64 of A-Z a-z 0-9 _ . -"),
        ("van-17\n", "front", "is no name"),
    ],
)
def test_a_name_that_makes_no_key_is_named_before_the_bus_is_asked(calibwatch, vehicle, pair, told):
    code, _, err = calibwatch("acknowledge", vehicle, pair, "--reason", "x", "--connect", NOBODY)
    assert code == 2
    assert told in err


@pytest.mark.usefixtures("unreachable")
@pytest.mark.parametrize(
    "options", [("--reason", ""), ("--reason", "x", "--by", "a\nb"), ("--reason", "x" * 201)]
)
def test_a_note_that_is_no_line_is_wrong_usage(calibwatch, options):
    code, _, err = calibwatch("acknowledge", "van-17", "front", *options, "--connect", NOBODY)
    assert code == 2
    assert "one line of 1 to 200 characters" in err
