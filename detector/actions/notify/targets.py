"""The targets of CloudEvents: an HTTP endpoint, or a Zenoh key.

HTTP requests follow CloudEvents' HTTP protocol binding 1.0: structured mode (section 3.2) or binary mode (3.1), whose
header values are percent-encoded (3.1.3.2).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from detector.access import AccessError, secret_text
from detector.actions.base import Messenger
from detector.actions.http import HttpClient, HttpError, ResponseOutcome, judge
from detector.actions.http.answer import retry_after_seconds
from detector.actions.notify.outbox import AttemptResult, Delivery
from wayside.api.actions.http import HttpAccess
from wayside.api.actions.notify import ContentMode, NotifyHttp, NotifyZenoh

STRUCTURED = "application/cloudevents+json"


class Target(Protocol):
    """Receives CloudEvents."""

    def send(self, event: Mapping[str, Any], give_up: Callable[[], bool]) -> Delivery:
        """Try once. Waits at most for the target's timeout, or until `give_up` is true."""


def event_json(event: Mapping[str, Any]) -> bytes:
    """A CloudEvent in JSON. Raises ValueError if a value has no form in JSON."""
    return json.dumps(event, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def structured(event: Mapping[str, Any]) -> tuple[dict[str, str], bytes]:
    """Headers and body of a request with the whole event as its body."""
    return {"Content-Type": f"{STRUCTURED}; charset=utf-8"}, event_json(event)


def binary(event: Mapping[str, Any]) -> tuple[dict[str, str], bytes]:
    """Headers and body of a request with the event's data as its body."""
    attributes = {name: value for name, value in event.items() if name not in ("data", "datacontenttype")}
    headers = {f"ce-{name}": _header_value(str(value)) for name, value in attributes.items()}
    return {"Content-Type": str(event["datacontenttype"]), **headers}, event_json(event["data"])


def _header_value(text: str) -> str:
    return "".join(
        character
        if "!" <= character <= "~" and character not in '"%'
        else "".join(f"%{byte:02X}" for byte in character.encode())
        for character in text
    )


class Poster:
    """Posts to one endpoint, and interprets its response."""

    def __init__(self, access: HttpAccess, field: str) -> None:
        """`field` is the place of `access` in the rule."""
        self._client = HttpClient(access, field)

    def post(self, url: str, headers: Mapping[str, str], body: bytes, give_up: Callable[[], bool]) -> Delivery:
        """Try once."""
        try:
            answer = self._client.send("POST", url, headers, body, give_up=give_up)
        except HttpError as error:
            return Delivery(AttemptResult.AGAIN, str(error), whole=True)
        verdict, why = judge(answer)
        if verdict is ResponseOutcome.DONE:
            return Delivery(AttemptResult.DELIVERED, why)
        if verdict is ResponseOutcome.FINAL:
            return Delivery(AttemptResult.REFUSED, why)
        return Delivery(
            AttemptResult.AGAIN,
            why,
            retry_after=retry_after_seconds(answer.retry_after, time.time()),
            whole=answer.busy,
        )


class HttpTarget:
    """An endpoint that receives CloudEvents by POST."""

    def __init__(self, http: NotifyHttp, field: str) -> None:
        self._http, self._field = http, field
        self._poster = Poster(http, field)

    def send(self, event: Mapping[str, Any], give_up: Callable[[], bool]) -> Delivery:
        """Try once."""
        try:
            headers, body = structured(event) if self._http.mode is ContentMode.STRUCTURED else binary(event)
        except ValueError as error:
            return Delivery(AttemptResult.REFUSED, f"cannot send the event as JSON: {error}")
        try:
            url = self._url()
        except AccessError as error:
            return Delivery(AttemptResult.AGAIN, str(error), whole=True)
        return self._poster.post(url, headers, body, give_up)

    def _url(self) -> str:
        secret = self._http.url_secret_key_ref
        if secret is None:
            return self._http.url or ""
        at = f"{self._field}.urlSecretKeyRef"
        url = secret_text(secret.name, secret.key, at).strip()
        if not url.startswith(("http://", "https://")):
            raise AccessError(f"{at}: the content of the Secret {secret.name} is not a URL: write https://… there")
        return url


class ZenohTarget:
    """A key of the detector's session. The session counts what it cannot send."""

    def __init__(self, zenoh: NotifyZenoh, messenger: Messenger) -> None:
        self._key, self._messenger = zenoh.key, messenger

    def send(self, event: Mapping[str, Any], give_up: Callable[[], bool]) -> Delivery:
        """Pass it to the session."""
        try:
            self._messenger.publish(self._key, event_json(event), STRUCTURED)
        except ValueError as error:
            return Delivery(AttemptResult.REFUSED, f"cannot send the event as JSON: {error}")
        return Delivery(AttemptResult.DELIVERED)
