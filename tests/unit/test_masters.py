"""Where the masters of one engine are."""

from __future__ import annotations

import pytest

from rce.config.client import ClientConfig
from rce.config.exceptions import ConfigError
from rce.config.loading import read_document
from rce.masters import Masters, split_addresses, split_port


def test_one_address_is_used_for_good() -> None:
    masters = Masters("http://one:9000/")
    masters.failed("http://one:9000/")
    assert masters.current == "http://one:9000/"


def test_several_are_used_in_turn() -> None:
    masters = Masters("a, b,c")
    assert masters.all == ("a", "b", "c")
    seen = []
    for _ in range(4):
        seen.append(masters.current)
        masters.failed(masters.current)
    assert seen == ["a", "b", "c", "a"]
    assert str(Masters(["a", "b"])) == "a,b"


def test_who_fails_late_does_not_skip_an_address() -> None:
    masters = Masters(["a", "b", "c"])
    masters.failed("a")
    masters.failed("a")
    assert masters.current == "b"


def test_others_are_untried_until_each_failed() -> None:
    masters = Masters(["a", "b", "c"])
    seen = []
    for _ in range(4):
        seen.append(masters.has_untried)
        masters.failed(masters.current)
        masters.failed("not in use")
    assert seen == [True, True, False, False]
    masters.worked()
    assert masters.has_untried
    assert masters.current == "b"
    assert masters.has_others
    alone = Masters("a")
    assert not alone.has_untried
    assert not alone.has_others


def test_a_round_is_over_when_each_failed_once_more() -> None:
    masters = Masters(["a", "b", "c"])
    seen = [masters.is_round_over]
    for _ in range(6):
        masters.failed(masters.current)
        seen.append(masters.is_round_over)
    assert seen == [True, False, False, True, False, False, True]
    masters.failed(masters.current)
    masters.worked()
    assert masters.is_round_over
    alone = Masters("a")
    alone.failed("a")
    assert alone.is_round_over


@pytest.mark.parametrize("nothing", ["", " , ", ()])
def test_no_address_is_refused(nothing: str | tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="give the address of a master"):
        Masters(nothing)
    assert split_addresses(" , ") == ()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("one", ("one", 8080)),
        ("one:81", ("one", 81)),
        ("10.0.0.1:65535", ("10.0.0.1", 65535)),
        ("::1", ("::1", 8080)),
        ("[::1]", ("::1", 8080)),
        ("[fe80::1]:81", ("fe80::1", 81)),
    ],
)
def test_an_address_may_have_a_port(text: str, expected: tuple[str, int]) -> None:
    assert split_port(text, 8080) == expected


@pytest.mark.parametrize("text", ["one:", "one:x", "one:0", "one:65536", "[::1]8", "[::1]:", "one:\u0661"])
def test_a_port_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="must be HOST or HOST:PORT"):
        split_port(text, 8080)


def config(url: object) -> ClientConfig:
    return ClientConfig.model_validate({"url": url, "userID": "u", "robotID": "r"})


def test_a_clients_file_names_one_or_several_masters() -> None:
    one, two = "http://one:9000/", "https://two:9000/"
    assert config(one).url == one
    assert config([one, two]).url == config(f"{one},{two}").url == f"{one},{two}"
    for wrong in ([], [one, 7], [one, "ftp://two/"], 7, ""):
        with pytest.raises(ValueError, match="must be the master's address"):
            config(wrong)


def test_task_sets_settings_name_one_or_several_masters() -> None:
    assert read_document({"master_host": "one,10.0.0.2"}, "file")["master_host"] == "one,10.0.0.2"
    assert read_document({"master_host": "one:81,[::1]:82"}, "file")["master_host"] == "one:81,[::1]:82"
    listed = read_document({"master_host": ["one:81", "[::1]:82"]}, "file")
    assert listed["master_host"] == "one:81,[::1]:82"
    assert read_document({"masters": ["one", "two"]}, "file") == {"master_host": "one,two"}
    assert read_document({"masters": "one"}, "file") == {"master_host": "one"}
    with pytest.raises(ConfigError, match="masters: means the same as master_host; give one of them"):
        read_document({"masters": ["one"], "master_host": "one"}, "file")
    for wrong in ([], ["one", 7], ["one,two"], [["one"]], 7):
        with pytest.raises(ConfigError, match="masters: must be"):
            read_document({"masters": wrong}, "file")
    with pytest.raises(ConfigError, match="must be HOST or HOST:PORT"):
        read_document({"master_host": "one:port"}, "file")
    with pytest.raises(ConfigError, match="must be a host name"):
        read_document({"master_host": "one,t!wo"}, "file")
