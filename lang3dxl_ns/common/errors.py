"""UserError: an error in data or settings that the user can fix."""


class UserError(Exception):
    """An error in the user's data or settings; the message names it and the remedy.

    Commands print the message alone, without a traceback.
    """
