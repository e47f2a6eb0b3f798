"""The tasks: what a domain is (``domain``), MuJoCo's inverted pendulum and Gymnasium's lunar lander.

Imports nothing else of the package. Every lesson uses it; lesson 00 shows it.
"""

from dmsrd_lite.domains.domain import Domain, InputError
from dmsrd_lite.domains.inverted_pendulum import INVERTED_PENDULUM
from dmsrd_lite.domains.lunar_lander import LUNAR_LANDER

DOMAINS = {domain.name: domain for domain in (INVERTED_PENDULUM, LUNAR_LANDER)}


def get_domain(name: str) -> Domain:
    """The ``Domain`` called ``name``; ``InputError`` for a name that is not in ``DOMAINS``."""
    if name not in DOMAINS:
        raise InputError(f"unknown domain {name!r}: expected one of {', '.join(DOMAINS)}")
    return DOMAINS[name]
