"""The static parts of the workbench's pages: HTML, scripts and style sheets from beside this module."""

from __future__ import annotations

import re
from pathlib import Path

from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

_PAGES = Path(__file__).parent / "pages"
_KINDS = {".js": "text/javascript", ".css": "text/css"}
_TOKEN = re.compile(r"[A-Za-z0-9_-]+")


def page_response(name: str, request: Request) -> Response:
    """One of our HTML pages, with the token carried on into the addresses of its parts."""
    token = request.query_params.get("token", "")
    html = (_PAGES / name).read_text(encoding="utf-8")
    # Tokens are of these characters alone; where none is asked for, nothing else is echoed into the page either.
    query = f"?token={token}" if _TOKEN.fullmatch(token) else ""
    return HTMLResponse(html.replace("{{query}}", query))


async def asset(request: Request) -> Response:
    """A script or style sheet of our pages."""
    name = request.path_params["name"]
    known = {path.name: path for path in _PAGES.iterdir() if path.suffix in _KINDS}
    if name not in known:
        return Response(status_code=404)
    return Response(known[name].read_bytes(), media_type=_KINDS[known[name].suffix])
