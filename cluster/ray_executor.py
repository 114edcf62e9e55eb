"""Shards as Ray tasks. The only file that imports ray.

Ray runs a task at least once; the store's commit makes that exactly once. A worker that dies is started again by Ray.
"""

import contextlib
import logging
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# Before the import: Ray reads them then. Usage statistics off; token authentication without a line about it.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_AUTH_MODE", "token")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
# What a Ray that is started here does five or ten times a second, on cores that train: its log monitor looks for new files for
# nobody, and once a second is enough for the rest.
os.environ.setdefault("RAY_LOG_MONITOR_MANY_FILES_THRESHOLD", "0")
os.environ.setdefault("LOG_NAME_UPDATE_INTERVAL_S", "inf")
os.environ.setdefault("RAY_raylet_check_gc_period_milliseconds", "1000")
os.environ.setdefault("RAY_raylet_report_resources_period_milliseconds", "1000")
os.environ.setdefault("RAY_object_manager_timer_freq_ms", "1000")
os.environ.setdefault("RAY_local_fs_monitor_interval_ms", "1000")
os.environ.setdefault("RAY_kill_idle_workers_interval_ms", "1000")

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from cluster.executor import Argument, ExecutorDiedError, Result
from cluster.worker import Receipt, Work, run_shard
from sweep.messages import UserError

_OBJECT_STORE_BYTES = 100 * 2**20
_MAX_RETRIES = 2  # whatever still dies then is tried in parts (`cluster.backlog`)
_CONNECT_SECONDS = 10.0


def check_address(address: str) -> None:
    """Raise UserError when nothing listens there: Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise UserError(f"--address {address}: must be HOST:PORT, as `ray start --head` prints it")
    try:
        socket.create_connection((host, int(port)), timeout=_CONNECT_SECONDS).close()
    except OSError as error:
        raise UserError(f"--address {address}: no Ray cluster answers there: {error}") from None


def _run_shard(work: Work, umask: int) -> Receipt:
    os.umask(umask)
    return run_shard(work)


@contextlib.contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Deliver Ctrl-C when Ray has started: in the middle of its start it crashes Ray, or leaves processes behind."""
    held: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda number, _frame: held.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if held:
        ray.shutdown()
        raise KeyboardInterrupt


class RayExecutor:
    """Runs shards on a local Ray of its own, or on the cluster at `address`; one CPU a shard."""

    name = "ray"

    def __init__(self, address: str | None = None, num_cpus: int | None = None) -> None:
        """Start Ray on this machine with `num_cpus` slots (default: all cores), or join the cluster at `address`."""
        with _interrupts_held_back():
            self._start(address, num_cpus)

    def _start(self, address: str | None, num_cpus: int | None) -> None:
        umask = os.umask(0o077)  # Ray writes its token file with the default mode otherwise; workers put the old one back
        try:
            if address is None:
                # a user's own modules, named in a grid, are found from the folder of the launch
                os.environ["PYTHONPATH"] = os.pathsep.join([os.getcwd(), *filter(None, [os.environ.get("PYTHONPATH")])])
                ray.init(
                    address="local",  # without it, Ray joins any cluster that it can see
                    num_cpus=num_cpus or os.cpu_count(),
                    include_dashboard=False,
                    object_store_memory=_OBJECT_STORE_BYTES,
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                )
            else:
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        finally:
            os.umask(umask)
        token = Path.home() / ".ray" / "auth_token"
        if token.exists():
            token.chmod(0o600)
        nodes: dict[str, Any] = {node["NodeID"]: node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]}
        self._largest_node = max(nodes, key=lambda node: nodes[node])
        self.slots = max(1, int(sum(nodes.values())))
        self.slots_on_a_machine = max(1, int(nodes[self._largest_node]))
        self._task = ray.remote(num_cpus=1, max_retries=_MAX_RETRIES)(_run_shard).options(name="run_shard")
        self._umask = umask
        self._running: dict[ray.ObjectRef, Work] = {}
        self._news = threading.Event()  # set when a task has ended

    def gather(self, function: Callable[[Argument], Result], argument: Argument, copies: int) -> list[Result]:
        task = ray.remote(num_cpus=1, max_retries=0)(function).options(
            name=function.__name__, scheduling_strategy=NodeAffinitySchedulingStrategy(self._largest_node, soft=False)
        )
        return ray.get([task.remote(argument) for _ in range(copies)])

    def submit(self, work: Work) -> None:
        reference = self._task.remote(work, self._umask)
        self._running[reference] = work
        reference.future().add_done_callback(lambda _future: self._news.set())

    def wait(self, seconds: float) -> list[Receipt]:
        if not self._running:
            return []
        self._news.wait(seconds)  # not in `ray.wait`: a Ctrl-C is heard at once, and two of them are two
        self._news.clear()
        running = list(self._running)
        ready, _ = ray.wait(running, num_returns=len(running), timeout=0)
        receipts: list[Receipt] = []
        for reference in ready:
            try:
                receipts.append(self._receipt(reference))
            except ExecutorDiedError:
                if not receipts:
                    raise
                return receipts  # the next call finds it dead again
        return receipts

    def _receipt(self, reference: "ray.ObjectRef") -> Receipt:
        work = self._running[reference]
        try:
            receipt = ray.get(reference)
            del self._running[reference]
            return receipt
        except (ray.exceptions.LocalRayletDiedError, ray.exceptions.RaySystemError) as error:
            raise ExecutorDiedError(str(error).strip().splitlines()[0]) from None
        except ray.exceptions.RayError as error:
            del self._running[reference]
            text = f"{error}\n{_DIED[_reason(error)]}" if _reason(error) in _DIED else str(error) or repr(error)
            tries = 1 + _MAX_RETRIES if _reason(error) in _DIED else 1
            return Receipt(work.shard, "unknown", error=text, reason=_reason(error), tries=tries)

    def close(self) -> None:
        self._running.clear()
        ray.shutdown()


_DIED = {
    "memory": "MemoryError: the worker was killed because the machine had no memory left",
    "killed": "WorkerDiedError: the worker's process died: it was killed, or crashed",
    "lost": "MachineLostError: the machine that the worker ran on was lost",
}


def _reason(error: Exception) -> str:
    """Return the class of a failure that the worker itself could not report."""
    if isinstance(error, ray.exceptions.OutOfMemoryError):
        return "memory"
    if isinstance(error, ray.exceptions.NodeDiedError):
        return "lost"
    return "killed" if isinstance(error, ray.exceptions.WorkerCrashedError) else "exception"
