"""Settings that can't be served safely are refused with a sentence."""

from pathlib import Path

import pytest

from studio.settings import Settings


def test_defaults_stay_on_this_machine() -> None:
    settings = Settings()
    assert settings.host == "127.0.0.1"
    assert settings.is_loopback


def test_the_environment_gives_port_runs_token_and_hosts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PORT", "1234")
    monkeypatch.setenv("MORPH_RUNS", "/data/runs")
    monkeypatch.setenv("MORPH_TOKEN", "hush, this is 24 letters")
    monkeypatch.setenv("MORPH_TRAINERS", "7")
    monkeypatch.setenv("MORPH_HOSTS", "studio.example.org, other.example.org")
    settings = Settings(host="0.0.0.0")
    assert (settings.port, settings.runs, settings.token) == (1234, Path("/data/runs"), "hush, this is 24 letters")
    assert settings.trainers == 7
    assert settings.hosts == ("studio.example.org", "other.example.org")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "example.org", ""])
def test_another_host_without_a_token_is_refused(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MORPH_TOKEN", raising=False)
    with pytest.raises(ValueError, match="without a token"):
        Settings(host=host)


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "127.0.0.2", "::1"])
def test_this_machine_needs_no_token(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MORPH_TOKEN", raising=False)
    assert Settings(host=host).token is None


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_out_of_range_is_refused(port: int) -> None:
    with pytest.raises(ValueError, match="0 to 65535"):
        Settings(port=port)


def test_a_port_that_is_no_number_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PORT", "eighty")
    with pytest.raises(ValueError, match="PORT must be"):
        Settings()


@pytest.mark.parametrize("token", ["", "  ", "tök", "a\nb"])
def test_a_token_that_no_header_can_carry_is_refused(token: str) -> None:
    with pytest.raises(ValueError, match="token"):
        Settings(token=token)


def test_the_token_is_not_printed() -> None:
    assert "hush" not in repr(Settings(token="hush"))


@pytest.mark.parametrize("token", ["a", "fifteen letters", "aaaaaaaaaaaaaaaaaaaaaaaa", "abababababababababababab"])
def test_a_token_that_can_be_guessed_is_refused_where_strangers_can_try(token: str) -> None:
    assert Settings(token=token).token == token
    with pytest.raises(ValueError, match="a token that can be guessed: give one of at least 16 characters"):
        Settings(host="0.0.0.0", token=token)


@pytest.mark.parametrize("trainers", ["0", "1025", "many", "-1", "1e3"])
def test_a_number_of_trainers_out_of_range_is_refused(monkeypatch: pytest.MonkeyPatch, trainers: str) -> None:
    monkeypatch.setenv("MORPH_TRAINERS", trainers)
    with pytest.raises(ValueError, match="must be a whole number from 1 to 1024"):
        Settings()
