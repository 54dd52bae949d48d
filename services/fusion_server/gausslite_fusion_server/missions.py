"""Open and close the missions of a server; each has a store, an engine and a servicer of its own."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from gausslite.domain.errors import GaussLiteError, InvalidInputError, QuotaError, StorageError
from gausslite.domain.names import quote_name, require_identifier
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.sqlite_file import remove_store
from gausslite.fusion.store import FusionStore
from gausslite_fusion_server.servicer import FusionServicer
from gausslite_fusion_server.settings import STORE_SUFFIX
from gausslite_fusion_server.store_follower import ServerLeadership, follow_store

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Mission:
    """One fused map and what serves it. file: its own file, which ends with it if it is unused.

    leadership: for a store that several servers share.
    """

    store: FusionStore
    engine: FusionEngine
    servicer: FusionServicer
    file: Path | None = None
    leadership: ServerLeadership | None = None

    async def follow_others(self) -> None:
        """Apply what other servers write to the store, until the task is cancelled."""
        if self.leadership is None:
            await asyncio.Event().wait()
        else:
            await follow_store(self.engine, self.leadership, self.servicer.publish_changes)

    def close(self) -> None:
        """End the work in threads, save the counters, and close the store."""
        self.servicer.close()
        # a full disk is in the log already
        with contextlib.suppress(StorageError):
            self.engine.save_counters()
        self.store.close()

    def discard(self) -> None:
        """Close an unused mission and delete its file."""
        self.close()
        if self.file is not None:
            remove_store(self.file)


OpenMission = Callable[[str], Mission]
"""Opens the mission of this id; the id is empty if the server serves one mission, whatever its name."""


class Missions:
    """Owns the missions of a server. They change on the event loop only.

    limit: largest number of missions. Above one, missions are named, and begin when the first agent joins.
    """

    def __init__(self, open_mission: OpenMission, limit: int, stored: tuple[str, ...] = ()) -> None:
        """Open the stored missions. Raises QuotaError if there are more than the limit, StorageError."""
        if len(stored) > limit:
            raise QuotaError(
                f"missions: expected at most {limit}, got {len(stored)} in the store; raise --max-missions"
            )
        self._open_mission, self._limit = open_mission, limit
        self._missions: dict[str, Mission] = {}
        self._is_draining = False
        self._beginning = asyncio.Lock()
        try:
            for name in stored or ([""] if limit == 1 else []):
                self._missions[name] = open_mission(name)
        except BaseException:
            self.close()
            raise

    @property
    def named(self) -> Mapping[str, Mission]:
        """The open missions by id; with a limit of one, the only one under an empty id."""
        return MappingProxyType(self._missions)

    def engines(self) -> tuple[FusionEngine, ...]:
        """Return the engines of all missions, also from another thread."""
        return tuple(mission.engine for mission in tuple(self._missions.values()))

    @property
    def only(self) -> Mission:
        """The mission of a server with a limit of one."""
        return self._missions[""]

    async def get_or_begin(self, mission_id: str) -> Mission:
        """Return the mission of this id; a new one begins if there is room.

        If the limit is reached, a mission without live agents and without data makes room. Raises InvalidInputError,
        QuotaError, StorageError.
        """
        require_identifier("mission_id", mission_id)
        if mission_id not in self._missions:
            # a caller that gives up must not leave a mission open that nobody owns
            await asyncio.shield(asyncio.ensure_future(self._begin(mission_id)))
        return self._missions[mission_id]

    def check(self) -> None:
        """Raise StorageError if the store of a mission cannot write."""
        for mission in tuple(self._missions.values()):
            mission.engine.storage.check()

    def drain(self) -> None:
        """End every open stream and every later call."""
        self._is_draining = True
        for mission in self._missions.values():
            mission.servicer.drain()

    def close(self) -> None:
        """Close all missions."""
        with contextlib.ExitStack() as closing:
            for mission in self._missions.values():
                closing.callback(mission.close)
        self._missions = {}

    async def _begin(self, mission_id: str) -> None:
        async with self._beginning:
            if mission_id in self._missions:
                return
            await self._make_room(mission_id)
            mission = await asyncio.to_thread(self._open_mission, mission_id)
            self._missions[mission_id] = mission
            _log.info("mission %s begins", mission_id)
            if self._is_draining:
                mission.servicer.drain()

    async def _make_room(self, mission_id: str) -> None:
        if len(self._missions) < self._limit:
            return
        unused = next((name for name, each in self._missions.items() if each.engine.is_unused), None)
        if unused is None:
            raise QuotaError(
                f"missions: expected at most {self._limit} on this server, {quote_name(mission_id)} exceeds it"
            )
        mission = self._missions.pop(unused)
        mission.servicer.drain()
        await asyncio.to_thread(mission.discard)


def stored_missions(folder: Path) -> tuple[str, ...]:
    """Return the ids of the missions with a file in the folder, sorted; the folder is made if it is missing.

    Raises StorageError if it cannot be made, InvalidInputError for a file instead of a folder.
    """
    if folder.is_file():
        raise InvalidInputError(f"--store {folder}: expected a folder with --max-missions, got a file")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"store {folder}: cannot be made ({error.strerror})") from error
    return tuple(sorted(path.stem for path in folder.glob(f"*{STORE_SUFFIX}") if _is_name(path.stem)))


def mission_file(folder: Path, mission_id: str) -> Path:
    """Return the file of a mission."""
    return folder / f"{mission_id}{STORE_SUFFIX}"


def _is_name(name: str) -> bool:
    try:
        require_identifier("mission_id", name)
    except GaussLiteError:
        return False
    return True
