"""The certificate of a server, from two files, as cert-manager mounts them. It is reloaded when the files change.

The files of a mounted Secret change without a restart. Changed files are used for new connections once they are valid;
until then, the previous certificate stays in use.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import ssl
from pathlib import Path

from wayside.inputerror import InputError

CERTIFICATE = "tls.crt"
KEY = "tls.key"
EVERY = 5.0
"""Seconds between two calls of `refresh`."""

log = logging.getLogger(__name__)


class CertificateError(InputError, ValueError):
    """There is no valid certificate in the folder; the message names the option, the folder and the reason."""


class ServingCertificate:
    """A TLS context for servers, whose certificate and key are those in the folder."""

    def __init__(self, folder: Path, option: str) -> None:
        """`option` names the folder in messages. Raises CertificateError without a valid certificate and key."""
        self._files = folder / CERTIFICATE, folder / KEY
        self._option = option
        self._logged = ""
        self.context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        try:
            self._seen = self._digest()
            self.context.load_cert_chain(*self._files)
        except (OSError, ssl.SSLError) as error:
            raise CertificateError(f"{option} {folder}: {_reason(error)}") from error

    def refresh(self) -> None:
        """Load the files if they have changed and are valid. Logs a renewal, and each problem once."""
        try:
            changed = self.reload()
        except (OSError, ssl.SSLError) as error:
            reason = _reason(error)
            if reason != self._logged:
                log.warning("%s: %s; keeping the previous certificate", self._option, reason)
            self._logged = reason
        else:
            self._logged = ""
            if changed:
                log.info("%s: using the renewed certificate", self._option)

    async def follow(self) -> None:
        """Call `refresh` periodically, until cancelled."""
        while True:
            await asyncio.sleep(EVERY)
            self.refresh()

    def reload(self) -> bool:
        """Load the files if they have changed. Returns whether they have.

        Raises OSError or ssl.SSLError for files that are not valid; the previous certificate then stays in use.
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
    """The problem of the files, in one line."""
    if isinstance(error, ssl.SSLError):
        if error.reason == "KEY_VALUES_MISMATCH":
            return f"{KEY} is not the key of {CERTIFICATE}: give a certificate and its own key"
        return f"{CERTIFICATE} and {KEY} are not a certificate and a key ({error.reason or error}): give PEM files"
    where = f"{Path(error.filename).name}: " if error.filename else ""
    return f"{where}{error.strerror or error}: the folder must contain {CERTIFICATE} and {KEY}, as in a TLS Secret"
