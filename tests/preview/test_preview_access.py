"""Who may use the server: pages of other sites, and clients with and without the token or its cookie."""

from urllib.parse import urlsplit

import httpx2 as httpx
import pytest

from mwdn.errors import ParameterError
from mwdn.preview.cameras import StoredCameras
from mwdn.preview.server import make_server
from preview_server import LIMITS


@pytest.mark.parametrize("headers", [{"origin": "http://evil.example"}, {"host": "evil.example"}, {"host": "[::"}])
def test_other_sites_pages_are_refused(client, headers):
    assert client.get("/cameras", headers=headers).status_code in (400, 403)


def test_other_addresses_need_a_token(serve):
    for token in ("", "schlüssel"):
        with pytest.raises(ParameterError, match="token"):
            make_server(StoredCameras(LIMITS), LIMITS, host="0.0.0.0", token=token)
    server = serve(host="0.0.0.0", token="secret")
    with httpx.Client(base_url=f"http://127.0.0.1:{urlsplit(server.url).port}") as client:
        assert client.get("/cameras").status_code == 401
        assert client.get("/cameras", headers={"authorization": "Bearer wrong"}).status_code == 401
        assert client.get("/cameras", headers={"authorization": "Bearer secret"}).status_code == 200
        assert client.get("/cameras", headers={"authorization": "bearer secret"}).status_code == 200  # RFC 9110, 11.1
        assert client.get("/cameras", headers={"authorization": "secret"}).status_code == 401
        assert client.get("/cameras?token=secret").status_code == 200
        assert client.get("/healthz").status_code == 200


def test_the_page_exchanges_its_token_for_a_cookie(serve):
    server = serve(host="0.0.0.0", token="secret")
    port = urlsplit(server.url).port
    with httpx.Client(base_url=f"http://127.0.0.1:{port}") as client:
        page = client.get("/?token=secret")
        assert (page.status_code, page.headers["location"]) == (303, "/")
        name = f"mwdn-preview-{port}"
        cookie = page.headers["set-cookie"]
        assert cookie.startswith(f"{name}=")
        assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(cookie.split("; "))
        assert "secret" not in cookie
        assert client.get("/").status_code == 200
        assert client.get("/cameras").status_code == 200
        other = {"origin": f"http://127.0.0.1:{port + 1}"}  # to this page the browser gives the cookie, too
        assert client.post("/inspect", headers=other).status_code == 401
        assert client.get("/cameras", headers={"authorization": "Bearer wrong"}).status_code == 401
    with httpx.Client(base_url=f"http://127.0.0.1:{port}") as client:
        assert "set-cookie" not in client.get("/?token=wrong").headers
        for wrong in ("", "secret", "ü"):
            assert client.get("/cameras", headers={"cookie": f"{name}={wrong}".encode()}).status_code == 401
        evil = {"origin": "http://evil.example"}
        assert "set-cookie" not in client.get("/?token=secret", headers=evil).headers


def test_a_server_without_a_token_sets_no_cookie(client):
    assert "set-cookie" not in client.get("/?token=secret").headers
