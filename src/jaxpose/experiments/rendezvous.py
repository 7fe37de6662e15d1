"""Processes of one training find each other before JAX connects them.

JAX's own connection ends a process that waits in vain without an exception (SIGABRT and a C++ stack); here a
missing process, one that is there twice, and one with other settings are a line of text each.
"""

import json
import socket
import time
from collections.abc import Collection, Mapping
from contextlib import ExitStack
from typing import Any

from jaxpose.errors import DataError

_PAUSE_S = 0.2


def address_of(coordinator: str) -> tuple[str, int]:
    """Host and port of HOST:PORT.

    Args:
        coordinator: As the user writes it.

    Returns:
        Both.

    Raises:
        ValueError: For other text.
    """
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 2**16:
        raise ValueError(f"--devices.coordinator: expected HOST:PORT, got {coordinator}")
    return host.strip("[]"), int(port)


def meet(
    coordinator: str, processes: int, process: int, settings: Mapping[str, Any], timeout_s: float
) -> None:
    """Wait until all processes of a training are there, with the same settings.

    Process 0 listens at the coordinator's address, the others report to it, and it answers when all have. The
    port is free again afterwards.

    Args:
        coordinator: HOST:PORT of process 0.
        processes: How many there are.
        process: Which one this is.
        settings: What all must have in common.
        timeout_s: How long to wait [s].

    Raises:
        DataError: In every process, where one does not come, comes twice, or has other settings.
    """
    host, port = address_of(coordinator)
    until = time.monotonic() + timeout_s
    common = json.loads(json.dumps(settings, default=str))
    complaint = (
        _lead(port, processes, common, until, coordinator)
        if process == 0
        else _report(host, port, {"process": process, "settings": common}, until, coordinator)
    )
    if complaint:
        raise DataError(complaint)


def _lead(port: int, processes: int, settings: dict[str, Any], until: float, coordinator: str) -> str:
    """What is wrong; empty: nothing."""
    with ExitStack() as opened:
        try:
            server = opened.enter_context(socket.create_server(("", port)))
        except OSError as error:
            return f"--devices.coordinator: expected a free port, got {coordinator}: {error.strerror}"
        others, complaint = {}, ""
        while len(others) < processes - 1 and not complaint:
            server.settimeout(max(until - time.monotonic(), 1e-3))
            try:
                connection = opened.enter_context(server.accept()[0])
                connection.settimeout(max(until - time.monotonic(), 1e-3))
                report = json.loads(connection.makefile("r", encoding="utf-8").readline())
            except TimeoutError:
                missing = sorted(set(range(1, processes)) - set(others.values()))
                complaint = (
                    f"--devices.processes: expected {processes} at {coordinator}, got no process "
                    f"{', '.join(map(str, missing))}"
                )
                break
            except (ValueError, OSError):
                continue  # something else that looked at the port
            complaint = _compared(report, settings, others.values(), processes)
            others[connection] = report["process"]
        for connection in others:
            connection.sendall(json.dumps({"complaint": complaint}).encode() + b"\n")
        return complaint


def _compared(
    report: dict[str, Any], settings: dict[str, Any], there: Collection[int], processes: int
) -> str:
    process = report["process"]
    if process in there or not 0 < process < processes:
        return f"--devices.process: expected 1 to {processes - 1}, each once, got {process} again"
    for name, value in settings.items():
        other = report["settings"].get(name)
        if other != value:
            return f"--{name.replace('_', '-')}: expected the same in all processes, got {value} and {other}"
    return ""


def _report(host: str, port: int, report: dict[str, Any], until: float, coordinator: str) -> str:
    """What process 0 says is wrong; empty: nothing."""
    reason = "no answer"
    while time.monotonic() < until:
        try:
            with socket.create_connection((host, port), timeout=max(until - time.monotonic(), 1e-3)) as there:
                there.sendall(json.dumps(report).encode() + b"\n")
                answer = there.makefile("r", encoding="utf-8").readline()
                return json.loads(answer)["complaint"]
        except (OSError, ValueError, KeyError) as error:
            reason = getattr(error, "strerror", None) or str(error) or "no answer"
            time.sleep(_PAUSE_S)
    return f"--devices.coordinator: expected process 0 at {coordinator}, got {reason}"
