"""The database action: episodes become scenarios in MongoDB, with the samples of their windows as documents.

The conversion from samples to documents is pure (documents, attachments, scenario). Documents wait in
one queue of the process (queue), on disk while the server is away, and are sent in order (writer, server).
"""

from detector.actions.database.action import Database

__all__ = ["Database"]
