"""Renews certificates and passwords when their files change: a second session replaces the first.

The credentials of a running session cannot be changed, and a router closes the connection when the certificate expires.
So the new credentials are tested with a separate session, beside the first; `stream_input` describes how no sample is
lost between them. If the new session cannot be opened, or receives nothing, the first one is kept, and that is logged.
A listening detector cannot listen twice: its session is closed and reopened, with the old credentials if the new ones
fail, and samples sent in between are lost.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import zenoh

from detector.access import LoadedCredentials
from detector.streams.liveliness import TokenWatch, subscribe_tokens
from detector.streams.loss_counter import LossCounter
from detector.streams.query_handler import QueryHandler
from detector.streams.session import Connections, NetworkError, credentials_of, open_session
from detector.streams.stream_input import StreamInput
from detector.streams.subscribing import Subscription, subscribe
from wayside.api.stream import Stream
from wayside.api.zenoh import Zenoh, ZenohMode
from wayside.process.backoff import retry

_CHANNEL = 16_384
"""Maximum number of samples of a stream that wait for its thread while the evaluation holds the interpreter's lock.
Once it is full, Zenoh's own queues fill, and then the sender's congestion control decides whether it waits or drops."""

_PATIENCE = 10.0
"""Seconds for which a session is kept that is no longer needed, but on which a response is awaited."""


class SessionSubscriptions:
    """Subscribed to all streams and to the clients' tokens. `of_streams` queue samples, in the streams' order."""

    def __init__(
        self,
        session: zenoh.Session,
        credentials: LoadedCredentials,
        streams: Sequence[Stream],
        tokens: str | None,
        loss_counter: LossCounter,
    ) -> None:
        """`tokens`: their key. Raises KeyPatternError, zenoh.ZError."""
        self.session = session
        self.credentials = credentials
        self.connections = Connections(session)
        self.of_streams: list[Subscription] = [subscribe(session, stream, _CHANNEL, loss_counter) for stream in streams]
        self.tokens = None if tokens is None else subscribe_tokens(session, tokens)
        self._query_handler: QueryHandler | None = None
        self._users = 0
        self._unused = threading.Condition()

    def answer(self, make_handler: Callable[[zenoh.Session], QueryHandler]) -> None:
        """Handle queries on this session from now on."""
        self._query_handler = make_handler(self.session)

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
        """Close at once; this unblocks the threads that wait to receive or to send."""
        self.connections.close()
        self.session.close()  # type: ignore[no-untyped-call]
        if self._query_handler is not None:
            self._query_handler.join(timeout)

    def await_connection(self, stop: threading.Event, seconds: float) -> bool:
        """Whether a connection exists within `seconds`."""
        until = time.monotonic() + seconds
        while not self.connections.any and time.monotonic() < until and not stop.wait(0.01):
            pass
        return self.connections.any


log = logging.getLogger(__name__)

CHECK_EVERY = 10.0
"""Seconds between two checks of the files; a kubelet takes about a minute to change them."""

_AT_LEAST, _AT_MOST = 1.0, 10.0
"""Minimum and maximum seconds of two subscribed sessions, so that both have delivered the same samples."""

_LOOK_AT_BOTH = 0.01

_REOPEN_EVERY = 0.2
"""Seconds between two attempts to open a closed session again, since samples are lost meanwhile."""

_AGAIN = 60.0
"""Seconds after which credentials that failed are tried again: the other side may have been the cause."""


@dataclass(frozen=True, slots=True)
class CertificateState:
    """The state of the credentials in use."""

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
        first: SessionSubscriptions,
        inputs: Sequence[StreamInput],
        tokens: TokenWatch | None,
        join: Callable[[zenoh.Session, LoadedCredentials], SessionSubscriptions],
        use: Callable[[SessionSubscriptions], None],
        *,
        check_every: float = CHECK_EVERY,
        on_failure: Callable[[BaseException], None],
    ) -> None:
        """`join` subscribes a session; `use` switches all outgoing data to a membership."""
        self._config = config
        self._member = first
        self._inputs = inputs
        self._tokens = tokens
        self._join = join
        self._use = use
        self._check_every = check_every
        self._on_failure = on_failure
        self._stop = threading.Event()
        self.reopening = threading.Event()
        """Set while there is no session because another one is being opened."""
        self._failed: LoadedCredentials | None = None
        self._again = 0.0
        self.certificate_state = CertificateState(first.credentials.expires)
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
            while not self._stop.wait(self._check_every):
                self._reload()
        except Exception as error:  # noqa: BLE001  otherwise certificates would expire unnoticed
            if not self._stop.is_set():
                log.critical(
                    "the thread that watches the certificates ended; renewed certificates are not loaded: %s", error
                )
                self._on_failure(error)

    def _reload(self) -> None:
        try:
            credentials = credentials_of(self._config)
        except NetworkError as error:
            self._set_problem(str(error))
            return
        if credentials == self._member.credentials:
            self._failed = None
            self._set_problem("")
        elif credentials != self._failed or time.monotonic() >= self._again:
            try:
                self._exchange(credentials)
            except NetworkError as error:
                self._failed, self._again = credentials, time.monotonic() + _AGAIN
                self._set_problem(str(error))

    def _set_problem(self, problem: str) -> None:
        if problem and problem != self.certificate_state.problem and not self._stop.is_set():
            log.warning("cannot use the new certificates or password; keeping the current session: %s", problem)
        self.certificate_state = CertificateState(
            self._member.credentials.expires, self.certificate_state.renewals, problem
        )

    def _exchange(self, credentials: LoadedCredentials) -> None:
        """Raises NetworkError if the new credentials fail; then nothing has changed."""
        listens = bool(self._config.listen) or self._config.mode is ZenohMode.ROUTER
        before = self._member
        if listens:
            self._reopen(credentials)
        else:
            self._replace_session(credentials)
        if self._member is before or self._stop.is_set():
            return
        self.certificate_state = CertificateState(credentials.expires, self.certificate_state.renewals + 1)
        until = (
            ""
            if credentials.expires is None
            else f", until {time.strftime('%FT%TZ', time.gmtime(credentials.expires))}"
        )
        log.info("zenoh: using the new certificates or password%s", until)

    def _replace_session(self, credentials: LoadedCredentials) -> None:
        first = self._member
        session = open_session(self._config, credentials)
        for stream_input in self._inputs:  # before the second subscription: every sample that comes twice is noted
            stream_input.note()
        second = self._join(session, credentials)
        try:
            self._run_both(first, second)
        except NetworkError:
            for stream_input in self._inputs:
                stream_input.forget()
            second.close()
            raise
        if self._stop.is_set():
            second.close()
            return
        self._member = second
        self._use(second)
        for stream_input in self._inputs:
            stream_input.expect()
            stream_input.withdraw()
        for stream_input, subscription in zip(self._inputs, second.of_streams, strict=True):
            stream_input.follow(subscription)
        if self._tokens is not None and first.tokens is not None and second.tokens is not None:
            self._tokens.follow(second.tokens, second.connections)
            first.tokens.undeclare()  # type: ignore[no-untyped-call]
        first.retire()

    def _run_both(self, first: SessionSubscriptions, second: SessionSubscriptions) -> None:
        """Run both until they have delivered the same samples. Raises NetworkError if the second receives nothing."""
        if first.connections.any and not second.await_connection(self._stop, _AT_MOST):
            raise NetworkError(
                f"zenoh: cannot connect to {[*self._config.connect]} with the new certificates or password"
            )
        begin = time.monotonic()
        pairs = [*zip(self._inputs, second.of_streams, strict=True)]
        while not self._stop.wait(_LOOK_AT_BOTH):
            for stream_input, subscription in pairs:
                stream_input.try_second(subscription)
            elapsed = time.monotonic() - begin
            if elapsed >= _AT_MOST or any(stream_input.full for stream_input in self._inputs):
                break
            if elapsed >= _AT_LEAST and not any(stream_input.waits for stream_input in self._inputs):
                break
        if not self._stop.is_set() and any(stream_input.only_first for stream_input in self._inputs):
            raise NetworkError(
                "zenoh: received nothing with the new certificates or password: the router must permit the new name "
                "to subscribe"
            )

    def _reopen(self, credentials: LoadedCredentials) -> None:
        try:
            self._close_and_open(credentials)
        finally:
            self.reopening.clear()

    def _close_and_open(self, credentials: LoadedCredentials) -> None:
        first, refused = self._member, None
        for stream_input in self._inputs:
            stream_input.expect()
        if self._tokens is not None:
            self._tokens.expect()
        began = time.monotonic()
        self.reopening.set()
        first.close()
        tried = credentials

        def attempt() -> SessionSubscriptions | None:
            return None if self._stop.is_set() else self._join(open_session(self._config, tried), tried)

        def failed(error: NetworkError) -> float:
            nonlocal refused, tried
            refused = refused or error
            tried = first.credentials
            return _REOPEN_EVERY

        second = retry(attempt, NetworkError, failed, self._stop.wait)
        if second is None:
            return
        if self._stop.is_set():
            second.close()
            return
        self._member = second
        self._use(second)
        for stream_input, subscription in zip(self._inputs, second.of_streams, strict=True):
            stream_input.follow(subscription)
        if self._tokens is not None and second.tokens is not None:
            self._tokens.follow(second.tokens, second.connections)
        lost = "zenoh: reopened the session within %.1f s: samples sent in the meantime are lost"
        log.warning(lost, time.monotonic() - began)
        if tried is not credentials and refused is not None:
            raise refused
