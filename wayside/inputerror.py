"""The errors that a command's user can mend."""


class InputError(Exception):
    """The input is wrong: a file, an option, the network or the cluster. The text names the location and the remedy.

    A command prints the text in one line, without a trace. Errors of this kind share the base, so that a command need
    not import the modules that raise them.
    """
