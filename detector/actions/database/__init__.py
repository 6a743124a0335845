"""The database action: episodes become scenarios in MongoDB, with the samples of their windows as documents.

From samples to documents it is pure (documents, values, attachments, png, pcd, scenario). Documents wait in one queue
of the process (store), on disk while the server is away (spool), and go to the server in their order (server).
"""

from detector.actions.database.action import Database

__all__ = ["Database"]
