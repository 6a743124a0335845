"""The errors that the user of a command can correct."""


class InputError(Exception):
    """The input is wrong: a file, an option, the network or the cluster. The text names the location and the remedy.

    A command prints the text in one line, without a traceback. All such errors have this base class, so that a command
    can catch them without importing the modules that raise them.
    """
