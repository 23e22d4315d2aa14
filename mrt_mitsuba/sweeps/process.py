"""Worker processes of this machine, each of which is started again when it ends."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import Mapping
from typing import Any

from distributed.deploy.subprocess import Subprocess


class WorkerProcess(Subprocess):
    """A worker in a new process. A nanny of the engine's would do the same in a process more for each
    worker, and have it return freed memory to the system at once, which makes a job an eighth slower.
    """

    def __init__(
        self, scheduler: str, name: int, options: Mapping[str, Any], environment: Mapping[str, str]
    ) -> None:
        super().__init__()
        spec = json.dumps({"cls": "distributed.Worker", "opts": dict(options)})
        self._command = [sys.executable, "-m", "distributed.cli.dask_spec", scheduler, "--spec", spec]
        self._environment = {**os.environ, **environment}
        self._keeping: asyncio.Task[None] | None = None

    async def _start(self) -> None:
        self._keeping = asyncio.create_task(self._keep())

    async def _keep(self) -> None:
        while True:
            self.process = await asyncio.create_subprocess_exec(*self._command, env=self._environment)
            await self.process.wait()

    async def close(self) -> None:
        """End the process for good."""
        if self._keeping:
            self._keeping.cancel()
        await super().close()
