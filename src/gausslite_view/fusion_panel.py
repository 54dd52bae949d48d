"""The panel of a fusion server: its map or one agent's, figures of each agent, and the start of a refinement."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from gausslite.codec.ply import gaussians_from_ply
from gausslite.domain.errors import GaussLiteError
from gausslite.process import size_text
from gausslite.wire.clients import Export, FusionClient
from gausslite_evaluation.compare import map_purpose
from gausslite_link.map_follower import MapFollower
from gausslite_objects.object_memory import ObjectMemory
from gausslite_view.agent_panel import place_text
from gausslite_view.cameras import TeamCameras, TeamKeyframes
from gausslite_view.contents import ViewContents, followed_contents
from gausslite_view.map_page import MapPage, text_html
from gausslite_view.objects_panel import ObjectsPanel
from gausslite_view.plots import TeamPlots

_FUSED, _REFINED = "fused map", "refined map"
_STRATEGIES = {_FUSED: "vote", _REFINED: "refine"}
_NS_PER_S = 1e9


class FusionPanel:
    """Owns the page's content while it follows one fusion server. `poll` is called on one thread."""

    def __init__(self, page: MapPage, client: FusionClient, memory: ObjectMemory) -> None:
        self._page, self._client = page, client
        self._follower = MapFollower(client.watch)
        self._started_s = time.monotonic()
        self._shown: tuple[object, ...] | None = None
        gui = page.server.gui
        with gui.add_folder("Fusion server", order=0):
            self._layer: Any = gui.add_dropdown("Shown map", [_FUSED])
            self._purpose = gui.add_html("")
            self._status = gui.add_html("")
            self._refine = gui.add_button("Start refinement")
            self._message = gui.add_html("")
        self.objects = ObjectsPanel(page, memory, self._draw_again)
        self._keyframes, self._cameras = TeamKeyframes(client), TeamCameras(page, client)
        with gui.add_folder("History", expand_by_default=False):
            self._plots = TeamPlots(gui, client)
        self._refine.on_click(lambda _: self.refine())

    def poll(self) -> None:
        """Read the server's status and draw what changed. Raises GaussLiteError."""
        status, time_s = self._client.status(), time.monotonic() - self._started_s
        self._show_status(status)
        self._plots.add_status(time_s, status)
        agents = [agent.agent_id for agent in status.agents]
        layers = (_FUSED, *([_REFINED] if status.refined else []), *agents)
        if layers != tuple(self._layer.options):
            self._layer.options = layers
        followed = self._follower.newest()
        revision = status.fused_revision if followed is None else followed.revision
        layer = str(self._layer.value)
        self._purpose.content = text_html([map_purpose(_STRATEGIES.get(layer, layer))])
        # an agent that replaces keyframes also sends updates, so that the revision changes
        keyframes = tuple((agent.agent_id, agent.keyframes) for agent in status.agents if agent.keyframes)
        shown = (layer, revision, keyframes, self._cameras.keyframes_back)
        if followed is None or (shown == self._shown and self._keyframes.is_complete):
            self._plots.add_keyframes(time_s, self._keyframes.newest, revision)
            return
        self._keyframes.read(status.agents)
        self._cameras.read(self._keyframes.newest)
        self._plots.add_keyframes(time_s, self._keyframes.newest, revision)
        targets = {agent.agent_id: tuple(agent.targets) for agent in status.agents}
        objects = tuple(team_object.landmark for team_object in self._client.query_objects())
        state_ns = round(time_s * _NS_PER_S)
        paths = self._keyframes.paths()
        fused = replace(followed_contents(followed, targets), objects=objects, paths=paths, state_ns=state_ns)
        fused = replace(fused, keyframes=self._cameras.draw(fused, state_ns))
        self.objects.show(fused)
        # the slider goes back in the fused map, whichever map is shown now
        self._page.remember(fused)
        self._page.show(fused if layer == _FUSED else self._download(layer, targets, fused))
        self._shown = shown

    def refine(self) -> None:
        """Refine the fused map; runs on a thread of the page's server."""
        self._refine.disabled = True
        try:
            for progress in self._client.refine():
                self._message.content = text_html(
                    [f"refinement: iteration {progress.iteration} of {progress.iterations}, loss {progress.loss:.4f}"]
                )
            self._message.content = text_html(["refinement complete: choose the refined map above"])
        except GaussLiteError as error:
            self._message.content = text_html([str(error)])
        finally:
            self._refine.disabled = False

    def close(self) -> None:
        """Close the client and end the follower."""
        self._client.close()
        self._follower.close()

    def _draw_again(self) -> None:
        self._shown = None

    def _download(self, layer: str, targets: dict[str, tuple[str, ...]], fused: ViewContents) -> ViewContents:
        """Return the refined map, or all that one agent has sent, in place of the fused one."""
        export = Export("refined") if layer == _REFINED else Export("concatenation", layer)
        agent_id = "" if layer == _REFINED else layer
        own = ViewContents.of_one_agent(gaussians_from_ply(self._client.export(export)), agent_id)
        return replace(
            fused, gaussians=own.gaussians, agent=own.agent, agents=own.agents, targets=targets.get(agent_id, ())
        )

    def _show_status(self, status: Any) -> None:
        mission = f"mission {status.mission_id!r}" if status.mission_id else "unnamed mission"
        lines = [
            f"{mission}: {status.fused_gaussians:,} Gaussians in "
            f"{status.fused_voxels:,} voxels, {status.keyframes} keyframes",
            *(
                f"{agent.agent_id}{'' if agent.joined else ' (left)'}{_task_text(agent)}: wins {agent.won_voxels:,} of "
                f"{agent.voxels:,} voxels, alone lacks {max(status.fused_voxels - agent.voxels, 0):,}; "
                f"{size_text(agent.roi_bytes + agent.handover_bytes)} received"
                f"{'; ' if agent.alignment.message else ''}{agent.alignment.message}"
                f"{place_text(agent)}"
                for agent in status.agents
            ),
        ]
        self._status.content = text_html(lines)


def _task_text(agent: Any) -> str:
    return f" for {', '.join(agent.targets)}" if agent.targets else ""
