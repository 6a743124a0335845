"""Renews certificates and passwords when their files change: a second session replaces the first.

The credentials of a running session cannot be changed, and a router closes the connection when the certificate expires.
So the new material is tested with a separate session, beside the first; `inlets` describes how no sample is lost
between them. If the new session cannot be opened, or receives nothing, the first one is kept, and that is logged. A
listening detector cannot listen twice: its session is closed and reopened, with the old material if the new one fails,
and samples sent in between are lost.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import zenoh

from detector.access.mounted import Material
from detector.streams.answering import Answering
from detector.streams.inlets import Inlet
from detector.streams.liveliness import TokenWatch, subscribe_tokens
from detector.streams.session import Connections, NetworkError, material_of, open_session
from detector.streams.subscribing import Subscription, subscribe
from detector.streams.tally import Tally
from wayside.api.stream import Stream
from wayside.api.zenoh import Zenoh, ZenohMode
from wayside.process.backoff import retry

_CHANNEL = 16_384
"""Maximum number of samples of a stream that wait for its thread while the evaluation holds the interpreter's lock.
Once it is full, Zenoh's own queues fill, and then the sender's congestion control decides whether it waits or drops."""

_PATIENCE = 10.0
"""Seconds for which a session is kept that is no longer needed, but on which a response is awaited."""


class Membership:
    """Subscribed to all streams and to the clients' tokens. `subscriptions` queue samples, in the streams' order."""

    def __init__(
        self, session: zenoh.Session, material: Material, streams: Sequence[Stream], tokens: str | None, tally: Tally
    ) -> None:
        """`tokens`: their key. Raises KeyPatternError, zenoh.ZError."""
        self.session = session
        self.material = material
        self.connections = Connections(session)
        self.subscriptions: list[Subscription] = [subscribe(session, stream, _CHANNEL, tally) for stream in streams]
        self.tokens = None if tokens is None else subscribe_tokens(session, tokens)
        self._answering: Answering | None = None
        self._users = 0
        self._unused = threading.Condition()

    def answer(self, answering: Callable[[zenoh.Session], Answering]) -> None:
        """Handle queries on this session from now on."""
        self._answering = answering(self.session)

    @contextmanager
    def used(self) -> Iterator[zenoh.Session]:
        """The session, which stays open until the context ends, unless it is closed for good."""
        with self._unused:
            self._users += 1
        try:
            yield self.session
        finally:
            with self._unused:
                self._users -= 1
                self._unused.notify_all()

    def retire(self) -> None:
        """Close once it is no longer used, and after ten seconds in any case."""
        with self._unused:
            self._unused.wait_for(lambda: not self._users, _PATIENCE)
        self.close()

    def close(self, timeout: float = 2.0) -> None:
        """Leave at once; this unblocks the threads that wait to receive or to send."""
        self.connections.close()
        self.session.close()  # type: ignore[no-untyped-call]
        if self._answering is not None:
            self._answering.join(timeout)

    def await_connection(self, stop: threading.Event, seconds: float) -> bool:
        """Whether a connection exists within `seconds`."""
        until = time.monotonic() + seconds
        while not self.connections.any and time.monotonic() < until and not stop.wait(0.01):
            pass
        return self.connections.any


log = logging.getLogger(__name__)

LOOK_EVERY = 10.0
"""Seconds between two checks of the files; a kubelet takes about a minute to change them."""

_AT_LEAST, _AT_MOST = 1.0, 10.0
"""Minimum and maximum seconds of two subscribed sessions, so that both have delivered the same samples."""

_LOOK_AT_BOTH = 0.01

_REOPEN_EVERY = 0.2
"""Seconds between two attempts to open a closed session again, since samples are lost meanwhile."""

_AGAIN = 60.0
"""Seconds after which material that failed is tried again: the other side may have been the cause."""


@dataclass(frozen=True, slots=True)
class CertificateState:
    """The state of the material in use."""

    expires: float | None = None
    """When the first certificate of the own chain expires, seconds since the epoch; None: it has none."""
    renewals: int = 0
    problem: str = ""
    """Why the current content of the files is not used."""


class Renewal:
    """Watches the files of one network until it is stopped, on a separate thread."""

    def __init__(
        self,
        config: Zenoh,
        first: Membership,
        inlets: Sequence[Inlet],
        tokens: TokenWatch | None,
        join: Callable[[zenoh.Session, Material], Membership],
        use: Callable[[Membership], None],
        *,
        look_every: float = LOOK_EVERY,
        on_failure: Callable[[BaseException], None],
    ) -> None:
        """`join` subscribes a session; `use` switches all outgoing data to a membership."""
        self._config = config
        self._member = first
        self._inlets = inlets
        self._tokens = tokens
        self._join = join
        self._use = use
        self._look_every = look_every
        self._on_failure = on_failure
        self._stop = threading.Event()
        self.reopening = threading.Event()
        """Set while there is no session because another one is being opened."""
        self._failed: Material | None = None
        self._again = 0.0
        self.certificate_state = CertificateState(first.material.expires)
        self._thread = threading.Thread(target=self._run, name="certificates", daemon=True)

    def start(self) -> None:
        """Start to watch the files, if there are any that can change."""
        config = self._config
        if any((config.tls, config.tls_secret_name, config.credentials, config.credentials_secret_name)):
            self._thread.start()

    def stop(self) -> None:
        """Start no further exchange; one in progress ends soon."""
        self._stop.set()

    def join(self, timeout: float) -> None:
        """Wait at most `timeout` seconds for the thread."""
        if self._thread.is_alive():
            self._thread.join(timeout)

    def _run(self) -> None:
        try:
            while not self._stop.wait(self._look_every):
                self._look()
        except Exception as error:  # noqa: BLE001  otherwise certificates would expire unnoticed
            if not self._stop.is_set():
                log.critical("cannot watch the certificates any more; renewed ones are not loaded: %s", error)
                self._on_failure(error)

    def _look(self) -> None:
        try:
            material = material_of(self._config)
        except NetworkError as error:
            self._set_problem(str(error))
            return
        if material == self._member.material:
            self._failed = None
            self._set_problem("")
        elif material != self._failed or time.monotonic() >= self._again:
            try:
                self._exchange(material)
            except NetworkError as error:
                self._failed, self._again = material, time.monotonic() + _AGAIN
                self._set_problem(str(error))

    def _set_problem(self, problem: str) -> None:
        if problem and problem != self.certificate_state.problem and not self._stop.is_set():
            log.warning("cannot use the new certificates or password; keeping the current session: %s", problem)
        self.certificate_state = CertificateState(
            self._member.material.expires, self.certificate_state.renewals, problem
        )

    def _exchange(self, material: Material) -> None:
        """Raises NetworkError if the new material fails; then nothing has changed."""
        listens = bool(self._config.listen) or self._config.mode is ZenohMode.ROUTER
        before = self._member
        if listens:
            self._reopen(material)
        else:
            self._take_over(material)
        if self._member is before or self._stop.is_set():
            return
        self.certificate_state = CertificateState(material.expires, self.certificate_state.renewals + 1)
        until = "" if material.expires is None else f", until {time.strftime('%FT%TZ', time.gmtime(material.expires))}"
        log.info("zenoh: using the new certificates or password%s", until)

    def _take_over(self, material: Material) -> None:
        first = self._member
        session = open_session(self._config, material)
        for inlet in self._inlets:  # before the second subscription: every sample that comes twice is noted
            inlet.note()
        second = self._join(session, material)
        try:
            self._run_both(first, second)
        except NetworkError:
            for inlet in self._inlets:
                inlet.forget()
            second.close()
            raise
        if self._stop.is_set():
            second.close()
            return
        self._member = second
        self._use(second)
        for inlet in self._inlets:
            inlet.expect()
            inlet.withdraw()
        for inlet, subscription in zip(self._inlets, second.subscriptions, strict=True):
            inlet.follow(subscription)
        if self._tokens is not None and first.tokens is not None and second.tokens is not None:
            self._tokens.follow(second.tokens, second.connections)
            first.tokens.undeclare()  # type: ignore[no-untyped-call]
        first.retire()

    def _run_both(self, first: Membership, second: Membership) -> None:
        """Run both until they have delivered the same samples. Raises NetworkError if the second receives nothing."""
        if first.connections.any and not second.await_connection(self._stop, _AT_MOST):
            raise NetworkError(
                f"zenoh: cannot connect to {[*self._config.connect]} with the new certificates or password"
            )
        begin = time.monotonic()
        pairs = [*zip(self._inlets, second.subscriptions, strict=True)]
        while not self._stop.wait(_LOOK_AT_BOTH):
            for inlet, subscription in pairs:
                inlet.try_second(subscription)
            elapsed = time.monotonic() - begin
            if elapsed >= _AT_MOST or any(inlet.full for inlet in self._inlets):
                break
            if elapsed >= _AT_LEAST and not any(inlet.waits for inlet in self._inlets):
                break
        if not self._stop.is_set() and any(inlet.only_first for inlet in self._inlets):
            raise NetworkError(
                "zenoh: received nothing with the new certificates or password: the router must permit the new name "
                "to subscribe"
            )

    def _reopen(self, material: Material) -> None:
        try:
            self._close_and_open(material)
        finally:
            self.reopening.clear()

    def _close_and_open(self, material: Material) -> None:
        first, refused = self._member, None
        for inlet in self._inlets:
            inlet.expect()
        if self._tokens is not None:
            self._tokens.expect()
        began = time.monotonic()
        self.reopening.set()
        first.close()
        tried = material

        def attempt() -> Membership | None:
            return None if self._stop.is_set() else self._join(open_session(self._config, tried), tried)

        def failed(error: NetworkError) -> float:
            nonlocal refused, tried
            refused = refused or error
            tried = first.material
            return _REOPEN_EVERY

        second = retry(attempt, NetworkError, failed, self._stop.wait)
        if second is None:
            return
        if self._stop.is_set():
            second.close()
            return
        self._member = second
        self._use(second)
        for inlet, subscription in zip(self._inlets, second.subscriptions, strict=True):
            inlet.follow(subscription)
        if self._tokens is not None and second.tokens is not None:
            self._tokens.follow(second.tokens, second.connections)
        lost = "zenoh: reopened the session within %.1f s: samples sent in the meantime are lost"
        log.warning(lost, time.monotonic() - began)
        if tried is not material and refused is not None:
            raise refused
