"""The one exception for everything a user can cause and put right."""

import difflib
from collections.abc import Collection, Iterable


class UserError(Exception):
    """A mistake in the input. Its text is one line: where (file, key, view), what is wrong, what to do.

    The command prints it without a traceback and exits with status 2. What it quotes (a key, a file name, another
    library's message) may hold line breaks; they become spaces.
    """

    def __init__(self, text: str) -> None:
        super().__init__(" ".join(str(text).split()))


class OptionError(UserError):
    """A mistake in an option. Its text starts with the option's name, before which the command puts its two dashes."""


def did_you_mean(name: object, known: Iterable[object]) -> str:
    """'; did you mean 'position'?' for the known name nearest to `name`, or '' where none is near."""
    near = difflib.get_close_matches(str(name), [str(k) for k in known], n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else ""


def refuse_unknown(option: str, value: object, what: str, known: Collection[str]) -> None:
    """OptionError where the value of an option is none of those known. what: 'stage'. None is no value, and passes."""
    if value is not None and not (isinstance(value, str) and value in known):
        hint = f"there is {', '.join(known)}{did_you_mean(value, known)}"
        raise OptionError(f"{option} {value}: there is no such {what}; {hint}")


def name_some(names: Iterable[object], most: int = 5) -> str:
    """'a, b, c and 4 more': a list short enough for one line."""
    words = [str(name) for name in names]
    rest = len(words) - most
    return ", ".join(words) if rest <= 0 else f"{', '.join(words[:most])} and {rest} more"


def amount(count: int, noun: str, plural: str | None = None) -> str:
    """'1 line', '2 lines', '3 more boxes'."""
    return f"{count} {noun if count == 1 else plural or noun + 's'}"
