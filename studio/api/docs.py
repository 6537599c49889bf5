"""GET /docs: the routes as one plain page, made from the OpenAPI schema; nothing is fetched from elsewhere."""

import html
import json
from typing import Any

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.openapi.utils import get_openapi
from fastapi.responses import HTMLResponse

from studio.api.messages import schemas


def openapi_of(app: FastAPI) -> dict[str, Any]:
    """Return the schema of all routes, with the run's messages as its components."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        document.setdefault("components", {}).setdefault("schemas", {}).update(schemas())
        app.openapi_schema = document
    return app.openapi_schema


def page_of(document: dict[str, Any]) -> str:
    """Return the page that lists routes and messages."""
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>MORPH Studio API</title>'
        '<meta name="viewport" content="width=device-width"><link rel="icon" href="page/icon.svg">'
        '<link rel="stylesheet" href="page/docs.css"><script src="page/theme.js"></script></head><body><main>'
        '<p><a class="name" href="./"><img src="page/icon.svg" alt="" width="20" height="20">MORPH Studio</a></p>'
        "<h1>API</h1>"
        "<p>Send <code>Authorization: Bearer TOKEN</code>, or open this page's server with its link once. Values that "
        'are not allowed are answered with 422 and <code>{"detail": "a sentence"}</code>. '
        '<a href="openapi.json">openapi.json</a></p><h2>Routes</h2>'
    ]
    for path, methods in document["paths"].items():
        for method, route in methods.items():
            parts.append(_route(path, method, route))
    parts.append("<h2>Messages</h2>")
    for name, shape in sorted(document["components"]["schemas"].items()):
        text = html.escape(json.dumps(shape, indent=2, ensure_ascii=False))
        about = html.escape(shape.get("description", "").partition("\n")[0])
        anchor = html.escape(name)
        parts.append(
            f'<details id="{anchor}"><summary><code>{anchor}</code> {about}</summary><pre>{text}</pre></details>'
        )
    return "".join(parts) + "</main></body></html>"


def _route(path: str, method: str, route: dict[str, Any]) -> str:
    lines = []
    for parameter in route.get("parameters", []):
        about = html.escape(parameter.get("description", ""))
        lines.append(f"<li>{html.escape(parameter['in'])} <code>{html.escape(parameter['name'])}</code> {about}</li>")
    if "requestBody" in route:
        lines.append(f"<li>body {_links(route['requestBody'])}</li>")
    for status, answer in route["responses"].items():
        if status.startswith("2"):
            lines.append(f"<li>{status} {html.escape(answer.get('description', ''))} {_links(answer)}</li>")
    return (
        f'<section><h3><span class="{method}">{method.upper()}</span> <code>{html.escape(path)}</code></h3>'
        f"<p>{html.escape(route.get('summary', ''))}</p><ul>{''.join(lines)}</ul></section>"
    )


def _links(part: object) -> str:
    """Return links to the messages that a part of the schema refers to."""
    if isinstance(part, dict):
        reference = part.get("$ref")
        if isinstance(reference, str):
            name = html.escape(reference.rpartition("/")[2])
            return f'<a href="#{name}">{name}</a> '
        return "".join(_links(value) for key, value in part.items() if key != "mapping")
    return "".join(_links(value) for value in part) if isinstance(part, list) else ""


def docs_router() -> APIRouter:
    """Return the routes of the page and of the schema that it is made from."""
    router = APIRouter(include_in_schema=False)

    @router.get("/docs")
    def docs(request: Request) -> Response:
        return HTMLResponse(page_of(openapi_of(request.app)))

    @router.get("/openapi.json")
    def schema(request: Request) -> Response:
        servers = [{"url": request.scope["root_path"] or "/"}]
        return Response(json.dumps(openapi_of(request.app) | {"servers": servers}), media_type="application/json")

    return router
