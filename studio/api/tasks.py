"""GET /api/tasks: what can be run, with every choice and default."""

import typing

from fastapi import APIRouter, Response

from morph_core.config import Method
from morph_core.catalogue import TASKS, make_task
from studio.api.messages import TaskInfo, TaskList, gives, gives_file, reply
from studio.fields import fields_of
from studio.preview import preview_svg


def task_list() -> TaskList:
    """Describe all tasks and methods."""
    tasks = []
    for name in TASKS:  # in the order of the start panel: the page shows the first one
        task = make_task(name)
        tasks.append(
            TaskInfo(
                name=name,
                title=task.title,
                explorations=list(task.explorations),
                z_unit=task.z_unit,
                options=fields_of(task),
                parameters=list(task.design_space.parameters),
                config=fields_of(task.config),
            )
        )
    return TaskList(tasks, list(typing.get_args(Method)))


def tasks_router() -> APIRouter:
    """Return the routes about tasks."""
    router = APIRouter(prefix="/api", tags=["tasks"])

    @router.get("/tasks", responses=gives(TaskList), summary="Tasks, methods and settings")
    def tasks() -> Response:
        return reply(task_list())

    @router.get(
        "/tasks/{name}/preview.svg", responses=gives_file("image/svg+xml", "The picture"), summary="The initial design"
    )
    def preview(name: str) -> Response:
        return Response(preview_svg(name), media_type="image/svg+xml")

    return router
