"""The HTTP client that actions share: one request at a time, with a deadline that always holds."""

from detector.actions.http.answer import Answer, ResponseOutcome, judge
from detector.actions.http.client import HttpClient, HttpError

__all__ = ["Answer", "HttpClient", "HttpError", "ResponseOutcome", "judge"]
