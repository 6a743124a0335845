"""The HTTP client of actions: deadlines, bounded responses, certificate checks, redacted secrets."""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from detector.actions.http import Answer, HttpClient, HttpError, ResponseOutcome, judge
from detector.actions.http.answer import retry_after_seconds
from tests.certificates import Authority
from tests.http_servers import Behaviour, answers, drips, echoes_headers, endpoint, endpoint_for, hangs, nobody, sends
from tests.patience import PATIENCE
from wayside.api.actions.http import HttpAccess, HttpHeader

OK = b"HTTP/1.1 200 OK\r\n"


SOON = PATIENCE / 2
"""Seconds: half of the timeout that a client has by default, and much more than anything here takes."""


def client(timeout: str = f"{PATIENCE:g}s", **access: Any) -> HttpClient:
    return HttpClient(HttpAccess.model_validate({"timeout": timeout, **access}), "spec.actions[0].notify.http")


def send(client: HttpClient, url: str, want: int = 0) -> Answer:
    return client.send("POST", url, {"Content-Type": "text/plain"}, b"hello", want=want)


def test_a_request_arrives_as_it_was_sent() -> None:
    with endpoint(answers(201, b"made")) as there:
        answer = send(client(headers=[{"name": "X-Site", "value": "north"}]), f"{there.url}/a%2Fb?c=%20d", want=100)
    (request,) = there.requests
    assert (request.method, request.path, request.body) == ("POST", "/a%2Fb?c=%20d", b"hello")
    assert request.headers["content-type"] == "text/plain"
    assert request.headers["x-site"] == "north"
    assert (answer.status, answer.body, answer.whole) == (201, b"made", True)


@pytest.mark.parametrize(
    "behaviour",
    [
        hangs(),
        hangs(b"HTTP/1.1 200"),
        drips(OK + b"X-Slow: "),
        drips(b"", b"H"),
    ],
    ids=["no answer", "half a status", "a header without end", "no status"],
)
def test_the_deadline_holds_whatever_the_endpoint_does(behaviour: Behaviour) -> None:
    with endpoint(behaviour) as there:
        begun = time.monotonic()
        with pytest.raises(HttpError):
            send(client("300ms"), there.url)
        assert time.monotonic() - begun < SOON


@pytest.mark.parametrize(
    "behaviour",
    [
        hangs(OK + b"Content-Length: 5\r\n\r\n"),
        drips(OK + b"\r\n"),
        drips(OK + b"Transfer-Encoding: chunked\r\n\r\n", b"1\r\nx\r\n"),
        sends(OK + b"Content-Length: 1000\r\n\r\nshort"),
    ],
    ids=["no body", "a body without end", "chunks without end", "less than announced"],
)
def test_without_a_wanted_body_a_success_counts_at_once(behaviour: Behaviour) -> None:
    with endpoint(behaviour) as there:
        begun = time.monotonic()
        assert send(client(), there.url).status == 200
        assert time.monotonic() - begun < SOON


def test_a_body_is_read_only_up_to_the_wanted_size() -> None:
    with endpoint(drips(OK + b"\r\n", b"x" * 10_000, 0.0001)) as there:
        answer = send(client(), there.url, want=30_000)
    assert (len(answer.body), answer.whole) == (30_000, False)


def test_a_body_shorter_than_announced_is_incomplete() -> None:
    with endpoint(sends(OK + b"Content-Length: 1000\r\n\r\nshort")) as there:
        answer = send(client(), there.url, want=2000)
    assert (answer.body, answer.whole) == (b"short", False)


def test_a_refusal_that_never_ends_is_reported_with_its_status() -> None:
    with endpoint(drips(b"HTTP/1.1 500 No\r\nContent-Type: text/plain\r\n\r\nthe disk is full", b"")) as there:
        answer = send(client("20s"), there.url)
    assert answer.status == 500
    assert judge(answer)[0] is ResponseOutcome.AGAIN


def test_redirects_are_not_followed() -> None:
    with endpoint() as elsewhere, endpoint(answers(307, Location=elsewhere.url)) as there:
        verdict, why = judge(send(client(), there.url))
        assert verdict is ResponseOutcome.FINAL
        assert "redirects are not followed" in why
        assert elsewhere.requests == []


@pytest.mark.parametrize(
    ("behaviour", "reported"),
    [
        (sends(b""), "closed the connection without a response"),
        (sends(b"SSH-2.0-OpenSSH_9.2\r\n"), "is not HTTP"),
        (sends(OK + b"Content-Length: 1\r\n\r\n" + b"x" * 100_000), "is not HTTP"),
        (sends(b"HTTP/1.1 200 OK\r\nX: " + b"a" * 100_000 + b"\r\n\r\n"), "is not HTTP"),
    ],
)
def test_a_response_that_is_not_http_is_reported(behaviour: Behaviour, reported: str) -> None:
    with endpoint(behaviour) as there, pytest.raises(HttpError, match=reported):
        send(client(), there.url)


def test_refused_connections_and_unknown_hosts_are_reported_without_the_path() -> None:
    with nobody() as there, pytest.raises(HttpError, match=rf"^{there}: cannot connect: "):
        send(client(), f"{there}/secret-path")
    with pytest.raises(HttpError, match=r"^http://nobody\.invalid:80: ") as caught:
        send(client("2s"), "http://nobody.invalid/secret-path")
    assert "secret" not in str(caught.value)


def test_a_cancelled_request_returns_at_once() -> None:
    closing = threading.Event()
    with endpoint(hangs()) as there:
        threading.Thread(target=lambda: (there.received(1), closing.set())).start()
        begun = time.monotonic()
        with pytest.raises(HttpError, match="aborted before the response"):
            client().send("POST", there.url, {}, b"", give_up=closing.is_set)
        assert time.monotonic() - begun < SOON


def test_certificates_are_checked(tmp_path: Path) -> None:
    known, unknown = Authority(tmp_path, "known"), Authority(tmp_path, "unknown")
    with endpoint(certificate=known.sign("server")) as there:
        assert send(client(tls={"ca": str(known.ca)}), there.url).status == 200
        with pytest.raises(HttpError, match="certificate is not trusted"):
            send(client(tls={"ca": str(unknown.ca)}), there.url)
        with pytest.raises(HttpError, match="certificate is not trusted"):
            send(client(), there.url)  # against the public authorities
        assert len(there.requests) == 1


def test_the_certificate_must_match_the_host_name_unless_disabled(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    with endpoint(certificate=authority.sign("server", "elsewhere")) as there:
        with pytest.raises(HttpError, match=r"certificate is not trusted: .*'localhost'"):
            send(client(tls={"ca": str(authority.ca)}), there.url)
        assert send(client(tls={"ca": str(authority.ca), "verifyName": False}), there.url).status == 200


def test_the_detector_presents_its_client_certificate(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    certificate, key = authority.sign("detector")
    own = {"ca": str(authority.ca), "certificate": str(certificate), "key": str(key)}
    with endpoint_for(authority.ca, authority.sign("server")) as there:
        assert send(client(tls=own), there.url).status == 200
        with pytest.raises(HttpError):
            send(client(tls={"ca": str(authority.ca)}), there.url)


def test_a_renewed_secret_is_used_for_later_requests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYSIDE_SECRETS", str(tmp_path))
    (tmp_path / "hook").mkdir()
    token = tmp_path / "hook" / "token"
    one = client(headers=[{"name": "Authorization", "secretKeyRef": {"name": "hook", "key": "token"}}])
    with pytest.raises(HttpError, match=r"^spec\.actions\[0\]\.notify\.http\.headers\[0\]\.secretKeyRef: cannot read "):
        send(one, "http://localhost:1")
    with endpoint() as there:
        for value in ("Bearer first\n", "Bearer second"):
            token.write_text(value)
            send(one, there.url)
    assert [request.headers["authorization"] for request in there.requests] == ["Bearer first", "Bearer second"]


def test_a_variable_and_credentials_become_headers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYSIDE_SECRETS", str(tmp_path))
    monkeypatch.setenv("WAYSIDE_KEY", "k-1")
    (tmp_path / "login").mkdir()
    (tmp_path / "login" / "username").write_text("ann")
    (tmp_path / "login" / "password").write_text("pass\n")
    with endpoint() as there:
        send(client(headers=[{"name": "X-Key", "variable": "WAYSIDE_KEY"}], credentialsSecretName="login"), there.url)
    assert there.requests[0].headers["x-key"] == "k-1"
    assert there.requests[0].headers["authorization"] == "Basic YW5uOnBhc3M="


def test_secrets_echoed_by_an_endpoint_are_redacted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYSIDE_KEY", "Bearer abcdef")
    with endpoint(echoes_headers()) as there:
        why = judge(send(client(headers=[{"name": "Authorization", "variable": "WAYSIDE_KEY"}]), there.url))[1]
    assert "authorization: ***" in why
    assert "abcdef" not in why


@pytest.mark.parametrize(
    ("status", "verdict"),
    [
        *((status, "DONE") for status in (200, 204)),
        *((status, "FINAL") for status in (301, 400, 401, 404, 413)),
        *((status, "AGAIN") for status in (408, 425, 429, 500, 501, 503, 599)),
    ],
)
def test_each_http_status_has_its_disposition(status: int, verdict: str) -> None:
    assert judge(Answer(status))[0].name == verdict


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("", 0),
        ("7", 7),
        (" 120 ", 120),
        ("9" * 30, 86_400),
        ("Thu, 01 Jan 2026 00:01:00 GMT", 60),
        ("Wed, 31 Dec 2025 00:00:00 GMT", 0),
        ("-5", 0),
        ("soon", 0),
        ("²", 0),
    ],
)
def test_retry_after_is_understood_in_both_forms(text: str, seconds: float) -> None:
    assert retry_after_seconds(text, 1_767_225_600.0) == seconds


@pytest.mark.parametrize(
    ("header", "reported"),
    [
        ({"name": "X"}, "exactly one of value, variable and secret"),
        ({"name": "X", "value": "a", "variable": "WAYSIDE_A"}, "exactly one of value, variable and secret"),
        ({"name": "X", "variable": "HOME"}, "pattern"),
        ({"name": "X", "value": "a\r\nY: b"}, "pattern"),
        ({"name": "X Y", "value": "a"}, "pattern"),
        ({"name": "Content-Length", "value": "1"}, "is set by the detector"),
        ({"name": "X", "secretKeyRef": {"name": "s", "key": "../other/key"}}, "pattern"),
    ],
)
def test_invalid_headers_are_rejected(header: dict[str, Any], reported: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(reported)):
        HttpHeader.model_validate(header)
