"""The webhook's server: HTTPS with a reloaded certificate, and immediate responses."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import yaml

from application_manager.admission.issuer import make_certificates
from application_manager.admission.webhook import AT_ONCE, LARGEST, ReviewHandler, WebhookOptions, webhook
from application_manager.commands.cli import EXPECTED, app
from application_manager.core.findings.reviews import OverloadedError, ReviewError
from application_manager.core.findings.webhooks import PATH
from application_manager.measures import Measures
from tests.patience import PATIENCE
from tests.ports import free_port
from tests.unit.manager_objects import DEPLOYMENT
from wayside.kubernetes.connection import ConfigurationError
from wayside.process import commandline
from wayside.process.servingcertificate import CertificateError, ServingCertificate

Ask = Callable[..., Awaitable[tuple[int, str]]]


def served(
    folder: Path,
    handler: ReviewHandler,
    scenario: Callable[[Ask], Awaitable[None]],
    authority: Path | None = None,
    headers: list[Mapping[str, str]] | None = None,
) -> None:
    """Run the scenario with a function that posts to the webhook; the headers of the answers are added to `headers`."""
    port = free_port()

    async def run() -> None:
        context = ssl.create_default_context(cafile=str(authority or folder / "ca.crt"))

        async def ask(body: bytes = b"{}", path: str = "/admission", method: str = "POST") -> tuple[int, str]:
            url = f"https://127.0.0.1:{port}{path}"
            async with (
                aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as session,
                session.request(method, url, data=body, ssl=context) as response,
            ):
                if headers is not None:
                    headers.append(response.headers)
                return response.status, await response.text()

        async with asyncio.timeout(PATIENCE), webhook(WebhookOptions(port, folder), {PATH: handler}):
            await scenario(ask)

    asyncio.run(run())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "certificates"
    make_certificates(made, ["127.0.0.1", "manager.wayside.svc"])
    return made


def failures(measures: Measures) -> str:
    return next(
        (line for line in measures.text().decode().splitlines() if 'answer="failed"' in line and "_total" in line), ""
    )


def test_a_valid_review_is_answered_and_an_invalid_request_is_rejected(folder: Path) -> None:
    measures = Measures()

    async def review(requested: Any) -> dict[str, Any]:
        if requested == "a defect":
            raise KeyError("spec")
        if not isinstance(requested, dict):
            raise ReviewError("is no AdmissionReview")
        return {"response": requested}

    async def scenario(ask: Ask) -> None:
        assert await ask(b'{"a": 1}') == (200, '{"response":{"a":1}}')
        assert await ask(b"[]") == (400, "is no AdmissionReview\n")
        assert (await ask(b"{"))[0] == 400
        assert (await ask(b'"\xff"'))[0] == 400
        assert (await ask(b'"a defect"'))[0] == 500
        assert (await ask(b" " * (LARGEST + 1)))[0] == 413
        assert (await ask(path="/"))[0] == 404
        assert (await ask(method="GET"))[0] == 405
        assert await ask(b'{"a": 2}') == (200, '{"response":{"a":2}}')

    served(folder, ReviewHandler(review, lambda: True, measures), scenario)
    assert failures(measures).endswith(" 5.0")


def test_no_review_is_answered_before_the_cache_is_complete(folder: Path) -> None:
    known: list[bool] = []

    async def review(requested: Any) -> dict[str, Any]:
        return {}

    async def scenario(ask: Ask) -> None:
        assert await ask() == (503, "the caches are not synced yet\n")
        known.append(True)
        assert (await ask())[0] == 200

    served(folder, ReviewHandler(review, lambda: bool(known), Measures()), scenario)


def test_an_overloaded_manager_does_not_make_the_api_server_wait(folder: Path) -> None:
    async def review(requested: Any) -> dict[str, Any]:
        raise OverloadedError("8 reviews are in progress: try again")

    async def scenario(ask: Ask) -> None:
        assert await ask() == (503, "8 reviews are in progress: try again\n")
        assert "Retry-After" not in headers[-1]

    headers: list[Mapping[str, str]] = []
    served(folder, ReviewHandler(review, lambda: True, Measures()), scenario, headers=headers)


def test_reviews_beyond_the_limit_are_rejected_at_once(folder: Path) -> None:
    all_there, proceed = asyncio.Event(), asyncio.Event()
    waiting: list[Any] = []

    async def review(requested: Any) -> dict[str, Any]:
        waiting.append(requested)
        if len(waiting) == AT_ONCE:
            all_there.set()
        await proceed.wait()
        return {}

    async def scenario(ask: Ask) -> None:
        requested = [asyncio.create_task(ask()) for _ in range(AT_ONCE)]  # type: ignore[arg-type]
        await all_there.wait()
        assert (await ask())[0] == 503
        proceed.set()
        assert {status for status, _ in await asyncio.gather(*requested)} == {200}
        assert (await ask())[0] == 200

    served(folder, ReviewHandler(review, lambda: True, Measures()), scenario)


def test_a_certificate_names_the_given_hosts_and_its_key_is_readable_by_the_owner_only(folder: Path) -> None:
    text = ssl._ssl._test_decode_cert(str(folder / "tls.crt"))  # type: ignore[attr-defined]
    assert text["subjectAltName"] == (("IP Address", "127.0.0.1"), ("DNS", "manager.wayside.svc"))
    assert (folder / "tls.key").stat().st_mode & 0o077 == 0


def test_renewed_certificate_files_are_loaded_atomically(folder: Path) -> None:
    certificate = ServingCertificate(folder, "--admission-certificates")
    assert not certificate.reload()
    old = {each.name: each.read_bytes() for each in folder.iterdir()}
    make_certificates(folder, ["127.0.0.1"])
    new = (folder / "tls.key").read_bytes()
    (folder / "tls.key").write_bytes(old["tls.key"])
    for _ in range(2):  # the new certificate without its key
        with pytest.raises(ssl.SSLError):
            certificate.reload()
    (folder / "tls.key").write_bytes(new)
    assert certificate.reload()
    assert not certificate.reload()


@pytest.mark.parametrize(
    ("spoil", "part"),
    [
        (lambda folder: (folder / "tls.key").unlink(), "tls.key: No such file or directory: the folder must"),
        (lambda folder: (folder / "tls.crt").write_text("x"), "are not a certificate and a key"),
        (lambda folder: make_certificates(folder / "b", ["a"]) and (folder / "b/tls.key").replace(folder / "tls.key"),
         "tls.key is not the key of tls.crt"),
    ],
    ids=["absent", "none", "of another"],
)  # fmt: skip
def test_files_that_cannot_be_used_are_reported_at_the_start(
    folder: Path, spoil: Callable[[Path], Any], part: str
) -> None:
    spoil(folder)
    with pytest.raises(CertificateError, match=r"^--admission-certificates .*certificates: ") as error:
        ServingCertificate(folder, "--admission-certificates")
    assert part in str(error.value)


def test_a_port_in_use_is_reported(folder: Path) -> None:
    async def review(requested: Any) -> dict[str, Any]:
        return {}

    handler = ReviewHandler(review, lambda: True, Measures())

    async def run() -> None:
        serving = WebhookOptions(free_port(), folder)
        async with webhook(serving, {PATH: handler}):
            with pytest.raises(ConfigurationError, match=f"--admission-port {serving.port}: .*give another port"):
                async with webhook(serving, {PATH: handler}):
                    pass

    asyncio.run(run())


# --- At the handler


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def command(*arguments: str) -> tuple[int, str, str]:
        code = commandline.run_cli(app, "application-manager", EXPECTED, arguments)
        return code, *capsys.readouterr()

    return command


def test_check_reports_rejections_with_file_and_line(
    command: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    file = tmp_path / "all.yaml"
    manifest = yaml.safe_dump(DEPLOYMENT)
    indented = "\n".join(f"      {line}" for line in manifest.splitlines())
    file.write_text(
        "apiVersion: wayside.dev/v1alpha1\nkind: ApplicationTemplate\nmetadata: {name: app}\nspec:\n"
        "  key: ${parameters.regoin}\n  parameters: {region: {type: string}}\n  manifests:\n    -\n" + indented + "\n"
        "---\napiVersion: wayside.dev/v1alpha1\nkind: EventRule\nmetadata: {name: fast}\nspec: {when: 'true'}\n"
    )
    code, _, logged = command("check", str(file))
    assert code == 1
    assert f"{file}:5:8: ApplicationTemplate app: spec.key" in logged
    assert "[invalid-template]" in logged
    assert "regoin" in logged
    assert "warning: " in logged
    assert "no valid Detector in namespace default selects the rule" in logged
    file.write_text(file.read_text().replace("regoin", "region"))
    code, _, logged = command("check", str(file))
    assert (code, logged.splitlines()[-1]) == (0, "checked 2: nothing would be refused")
    assert [line.rpartition(" ")[2] for line in logged.splitlines()[:-1]] == [
        "[failing-example]",
        "[rule-not-selected]",
    ]
    alone = (0, "", "checked 2: nothing would be refused\n")
    ignoring = ("--ignore", "rule-not-selected", "--ignore", "failing-example")
    assert command("check", str(file), *ignoring) == alone
    annotation = "annotations: {wayside.dev/ignore-findings: rule-not-selected}"
    file.write_text(file.read_text().replace("{name: fast}", f"{{name: fast, {annotation}}}"))
    assert command("check", str(file), *ignoring[2:]) == alone
    assert command("check", str(file), "--ignore", "invalid-rule")[0] == 2


def test_check_finds_no_rejections_in_the_examples(
    command: Callable[..., tuple[int, str, str]],
) -> None:
    folders = sorted({str(each.parent) for each in Path("examples").rglob("template*.yaml")})
    assert folders
    for folder in folders:
        code, _, logged = command("check", folder)
        assert code == 0, logged


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["run", "--admission-port", "9443"], "give both --admission-port"),
        (["webhooks"], "give either --service NAMESPACE/NAME or --url"),
        (
            ["webhooks", "--service", "manager"],
            "must be NAMESPACE/NAME or NAMESPACE/NAME:PORT of a Service; got 'manager'",
        ),
        (["webhooks", "--service", "a/b", "--ca-bundle", "nowhere.crt"], "nowhere.crt: No such file"),
        (["webhooks", "--service", "a/b", "--ca-bundle", "pyproject.toml"], "contains no certificate"),
    ],
)
def test_a_usage_error_is_one_line_with_the_remedy(
    command: Callable[..., tuple[int, str, str]], arguments: list[str], part: str
) -> None:
    code, out, logged = command(*arguments)
    assert (code, out, logged.count("\n")) == (2, "", 1)
    assert part in logged
