"""Tokens of an OpenID Connect issuer at the doors of a real service, beside API keys."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import httpx
import pytest

from ultragray_client import Client
from ultragray_proto.v1 import scenes_pb2, scenes_pb2_grpc
from ultragray_service.access.keys import KeyStore
from ultragray_service.access.principals import Role
from ultragray_workers.jobs.database import JobDatabase

from ...waiting import wait_until
from ..conftest import RunningService, StartService
from ..rpc.test_grpc_render import error_info
from .conftest import MATRIX
from .identity_provider import IdentityProvider

KEY = "0123456789abcdef-environment"


@pytest.fixture(scope="module")
def provider() -> Iterator[IdentityProvider]:
    found = IdentityProvider()
    found.add_key("one")
    yield found
    found.close()


@pytest.fixture(scope="module")
def guarded(start_service: StartService, provider: IdentityProvider) -> RunningService:
    service = start_service(**provider.settings(), api_keys=KEY)
    wait_until(lambda: identity_provider(service) == "available")
    return service


def identity_provider(service: RunningService) -> str:
    told: str = httpx.get(f"{service.http}/v1/health/ready", timeout=60).json()["identity_provider"]
    return told


def ask(service: RunningService, credential: str) -> httpx.Response:
    return httpx.get(f"{service.http}/v1/scenes", headers={"Authorization": f"Bearer {credential}"}, timeout=60)


def test_a_token_opens_both_doors(guarded: RunningService, provider: IdentityProvider) -> None:
    assert ask(guarded, provider.token()).status_code == 200
    given = iter([provider.token(), provider.token(exp=1)])
    with Client(guarded.grpc, api_key=lambda: next(given), timeout_s=60.0) as client:
        assert client.scenes.list()
        with pytest.raises(Exception, match="UNAUTHENTICATED: the token has expired"):
            client.scenes.list()


def test_tokens_that_are_refused_say_why_at_the_doors(guarded: RunningService, provider: IdentityProvider) -> None:
    for token, status, reason in (
        (provider.token(aud="another"), 401, "UNAUTHENTICATED"),
        (provider.token(realm_access=None), 403, "PERMISSION_DENIED"),
    ):
        answer = ask(guarded, token)
        assert (answer.status_code, answer.json()["reason"]) == (status, reason)
        metadata = (("authorization", f"Bearer {token}"),)
        with guarded.channel() as channel:
            stub = scenes_pb2_grpc.SceneServiceStub(channel)
            with pytest.raises(grpc.RpcError) as caught:
                stub.ListScenes(scenes_pb2.ListScenesRequest(), metadata=metadata)
        assert error_info(caught.value)[0].reason == reason
    assert "eyJ" not in guarded.log_path.read_text(), "a token was logged"


@pytest.mark.long
def test_an_issuer_that_is_away_shuts_out_only_its_tokens(start_service: StartService) -> None:
    provider = IdentityProvider()
    provider.add_key("one")
    provider.up = False
    try:
        service = start_service(**provider.settings(), api_keys=KEY)
        assert ask(service, KEY).status_code == 200
        refused = ask(service, provider.token())
        assert (refused.status_code, refused.json()["reason"]) == (503, "ISSUER_UNAVAILABLE")
        assert int(refused.headers["retry-after"]) >= 1
        assert identity_provider(service) == "unavailable"
        wait_until(lambda: any("cannot be checked" in record["message"] for record in service.log()))
        provider.up = True
        wait_until(lambda: ask(service, provider.token()).status_code == 200)
        assert identity_provider(service) == "available"
    finally:
        provider.close()


@pytest.mark.long
def test_a_rotation_of_keys_leaves_sessions_and_their_revocation_alone(
    start_service: StartService, tmp_path: Path
) -> None:
    provider = IdentityProvider()
    provider.add_key("one")
    database = JobDatabase(tmp_path, None)
    store = KeyStore(database.engine)
    _, bob = store.create("bob", Role.OPERATOR, None)
    try:
        service = start_service(**provider.settings(), artifact_folder=tmp_path)
        wait_until(lambda: identity_provider(service) == "available")
        with ThreadPoolExecutor() as threads, httpx.Client(base_url=service.http, timeout=None) as client:
            body = {"kind": "render", "specification": {"scene": "demo", "poses": [MATRIX]}}
            job = client.post("/v1/jobs", json=body, headers={"X-API-Key": bob}).json()["id"]  # no worker takes it
            opened: list[str] = []

            def watch(credential: str) -> None:
                headers = {"Authorization": f"Bearer {credential}"}
                with client.stream("GET", f"/v1/jobs/{job}/events", headers=headers) as events:
                    opened.append(credential)
                    with pytest.raises(httpx.RemoteProtocolError):  # cut
                        events.read()

            of_token = threads.submit(watch, provider.token("one"))
            of_key = threads.submit(watch, bob)
            wait_until(lambda: len(opened) == 2)
            provider.add_key("two")
            provider.remove_key("one")
            wait_until(lambda: ask(service, provider.token("two")).status_code == 200)
            assert not of_key.done()
            store.revoke("bob")
            of_key.result(60)
            of_token.result(60)  # its key is gone for good
    finally:
        database.close()
        provider.close()


def test_the_page_is_told_where_people_sign_in(start_service: StartService) -> None:
    provider = IdentityProvider()
    provider.add_key("one")
    provider.endpoints = {
        "authorization_endpoint": f"{provider.url}/auth",
        "token_endpoint": "https://tokens.hospital.example:8443/token",
    }
    try:
        service = start_service(**provider.settings(), oidc_client_id="console", oidc_scope="openid roles")
        wait_until(lambda: identity_provider(service) == "available")
        assert httpx.get(f"{service.http}/v1/sign-in", timeout=60).json() == {
            "provider": {**provider.endpoints, "client_id": "console", "scope": "openid roles"}
        }
        policy = httpx.get(service.http, timeout=60).headers["content-security-policy"]
        assert policy.endswith(" https://tokens.hospital.example:8443")
    finally:
        provider.close()


def test_without_a_client_id_people_sign_in_with_keys(guarded: RunningService) -> None:
    assert httpx.get(f"{guarded.http}/v1/sign-in", timeout=60).json() == {"provider": None}
    assert "hospital" not in httpx.get(guarded.http, timeout=60).headers["content-security-policy"]


def test_an_endpoint_without_encryption_is_not_taken(start_service: StartService) -> None:
    provider = IdentityProvider()
    provider.add_key("one")
    provider.endpoints = {"authorization_endpoint": f"{provider.url}/auth", "token_endpoint": "http://hospital.example"}
    try:
        service = start_service(**provider.settings(), oidc_client_id="console", api_keys=KEY)
        wait_until(lambda: any("token_endpoint must be a URL" in record["message"] for record in service.log()))
        assert httpx.get(f"{service.http}/v1/sign-in", timeout=60).json() == {"provider": None}
    finally:
        provider.close()
