"""The certificate of the manager's servers, followed in its event loop."""

from __future__ import annotations

import asyncio

from wayside.process.servingcertificate import EVERY, ServingCertificate


async def follow(certificate: ServingCertificate) -> None:
    """Use the files' new contents whenever they change, until cancelled."""
    while True:
        await asyncio.sleep(EVERY)
        certificate.refresh()
