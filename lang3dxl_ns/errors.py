"""The one error that a person, not a program, is meant to read."""


class UserError(Exception):
    """Something in the user's data or settings is wrong; the message names it and the remedy.

    Commands print the message alone, without a traceback.
    """
