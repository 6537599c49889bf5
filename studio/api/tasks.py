"""GET /api/tasks: what can be run, with every choice and default."""

from fastapi import APIRouter, Response

from morph_core.catalogue import METHODS, TASKS, broken_plugins, make_method, make_task
from morph_core.presets import PRESETS
from studio.api.messages import BrokenPlugin, PresetInfo, TaskInfo, TaskList, gives, gives_file, reply
from studio.fields import fields_of, settings_of
from studio.preview import preview_svg


def task_list() -> TaskList:
    """Describe all tasks and methods, those of plug-ins too."""
    tasks = []
    for name in TASKS:  # in the order of the start panel: the page shows the first one
        task = make_task(name)
        settings = {method: settings_of(make_method(method, task), task) for method in METHODS}
        tasks.append(
            TaskInfo(
                name=name,
                title=task.title,
                z_unit=task.z_unit,
                options=fields_of(task),
                parameters=list(task.design_space.parameters),
                settings=settings,
            )
        )
    broken = [BrokenPlugin(b.group, b.name, b.package, b.reason) for b in broken_plugins()]
    titles = {name: METHODS[name].title for name in METHODS}
    presets = [PresetInfo(preset.name, preset.meaning, preset.method) for preset in PRESETS.values()]
    return TaskList(tasks, list(METHODS), titles, presets, broken)


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
