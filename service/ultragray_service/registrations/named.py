"""Registrations by name, as all front doors tell them."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import described
from ultragray.registration.registration import Registration


@dataclass(frozen=True, kw_only=True)
class NamedRegistration(Registration):
    """A registration that the service keeps."""

    name: str = described("Chosen by who put it.")
    scene: str = described("That its poses lead into.")
    owner: str | None = described("Who put it; null: nobody.", None)
    changed_at: str = described("ISO 8601, UTC.")


@dataclass(frozen=True)
class RegistrationPage:
    """One page of registrations by name."""

    registrations: list[NamedRegistration]
    next_page_token: str = described("Empty on the last page.")
