"""The certificate that the manager shows to the API server: two files, as cert-manager mounts them, and followed.

A Secret that is renewed changes in its mount by itself. New files are tried first, and taken for all connections from
then on only if they are whole; until then, and where they are not, the old ones stay.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import ssl
from pathlib import Path

from application_manager.cluster.connection import ConfigurationError

CERTIFICATE = "tls.crt"
KEY = "tls.key"
EVERY = 5.0  # s between two looks at the files

log = logging.getLogger(__name__)


class ServingCertificate:
    """A TLS context for servers, whose certificate and key are those in the folder.

    Raises ConfigurationError where there are none that can be used.
    """

    def __init__(self, folder: Path, option: str) -> None:
        """`option`: what the folder was given by, for messages."""
        self._files = folder / CERTIFICATE, folder / KEY
        self._option = option
        self.context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        try:
            self._seen = self._digest()
            self.context.load_cert_chain(*self._files)
        except (OSError, ssl.SSLError) as error:
            raise ConfigurationError(f"{option} {folder}: {_reason(error)}") from error

    async def follow(self) -> None:
        """Take the files' new contents whenever they change, until cancelled."""
        told = ""
        while True:
            await asyncio.sleep(EVERY)
            try:
                changed = self.renewed()
            except (OSError, ssl.SSLError) as error:
                reason = _reason(error)
                if reason != told:
                    log.warning("%s: %s; the certificate of before stays", self._option, reason)
                told = reason
            else:
                told = ""
                if changed:
                    log.info("%s: the certificate was renewed", self._option)

    def renewed(self) -> bool:
        """Take the files if they have changed; whether they have.

        Raises OSError or ssl.SSLError for files that cannot be used; then those of before stay.
        """
        digest = self._digest()
        if digest == self._seen:
            return False
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(*self._files)
        self.context.load_cert_chain(*self._files)
        self._seen = digest
        return True

    def _digest(self) -> bytes:
        return hashlib.sha256(b"\0".join(each.read_bytes() for each in self._files)).digest()


def _reason(error: OSError) -> str:
    """What is wrong with the files, in one line."""
    if isinstance(error, ssl.SSLError):
        if error.reason == "KEY_VALUES_MISMATCH":
            return f"{KEY} is not the key of {CERTIFICATE}: give both of one pair"
        return f"{CERTIFICATE} and {KEY} are no certificate and key ({error.reason or error}): give PEM files"
    where = f"{Path(error.filename).name}: " if error.filename else ""
    return f"{where}{error.strerror or error}: the folder must hold {CERTIFICATE} and {KEY}, as a Secret has them"
