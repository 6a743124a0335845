"""A source for Wayside's detector: each UDP datagram is JSON text, `{"key": "sites/north/count", "value": {…}}`."""

from __future__ import annotations

import json
import socket

from pydantic import BaseModel, ConfigDict, Field

from detector.sources import Feed, Source


class UdpParameters(BaseModel):
    """The fields of `spec.sources[].parameters`; `detector check` reports validation errors of this model."""

    model_config = ConfigDict(extra="forbid")

    address: str = Field(default="127.0.0.1", description="Where to listen.")
    port: int = Field(ge=1, le=65535, description="The UDP port to listen on.")


class UdpSource(Source[UdpParameters]):
    """Datagrams become messages. One that is none is passed over."""

    Parameters = UdpParameters

    def run(self, feed: Feed) -> None:
        """Listen until stopped. A port that is in use raises OSError: the detector logs it and tries again."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind((self.parameters.address, self.parameters.port))
            receiver.settimeout(0.2)  # the period of checks for a stop
            while not feed.stopping:
                try:
                    datagram = receiver.recv(65536)
                except TimeoutError:
                    continue
                try:
                    message = json.loads(datagram)
                    key, payload = message["key"], json.dumps(message["value"]).encode()
                except (ValueError, LookupError, TypeError):
                    continue
                feed.put(str(key), payload)
