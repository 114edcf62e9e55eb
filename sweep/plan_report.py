"""A plan as a user reads it: one row a group of trials, then the whole."""

from rich import box
from rich.console import Console
from rich.table import Table

from sweep.plan import Plan
from sweep.shards import name_of

_PLAIN_WIDTH = 130
_COLUMNS = ("trials", "shards", "population", "agent-steps/s", "core-hours", "memory")


def show(plan: Plan, console: Console) -> None:
    """Print a plan. Without a terminal, lines are as long as they need to be."""
    if not console.is_terminal:
        console.width = max(console.width, _PLAIN_WIDTH)
    if not plan.missing:
        _say(console, f"{plan.study}: all {plan.trials:,} trials are finished; nothing to do.")
        return
    workers, shards = _counted(plan.slots.count, "worker"), _counted(plan.shards, "shard")
    _say(
        console,
        f"{plan.study}: {plan.trials:,} trials, {plan.finished:,} finished, {plan.missing:,} missing: "
        f"{plan.agent_steps:,} agent-steps in {shards} on {workers}, engine {plan.engine}",
    )
    console.print(_table(plan))
    for line in _totals(plan, workers):
        _say(console, line)


def _say(console: Console, line: str) -> None:
    console.print(line, highlight=False, markup=False, soft_wrap=True)


def _table(plan: Plan) -> Table:
    groups = [group.group for group in plan.groups]
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    table.add_column("trials of", overflow="fold")
    for name in _COLUMNS:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("rate is", overflow="fold")
    for group in plan.groups:
        table.add_row(
            name_of(group.group, groups),
            f"{group.trials:,}",
            f"{group.shards:,}",
            f"{group.population:,}",
            f"{group.agent_steps_per_second:,.0f}",
            _number(group.core_hours),
            _bytes(group.memory_bytes),
            group.how,
        )
    return table


def _totals(plan: Plan, workers: str) -> list[str]:
    available = plan.slots.available_bytes
    at_hand = f" ({_bytes(available)} are available)" if available else ""
    lines = [
        f"time    {_number(plan.core_hours)} core-hours: about {_duration(plan.hours)} on {workers}",
        f"memory  {_bytes(plan.memory_bytes)} a worker, {_bytes(plan.machine_memory_bytes)} for all on a machine{at_hand}",
        f"disk    {_bytes(plan.bytes)}",
    ]
    if any(group.how.startswith("nominal") for group in plan.groups):
        lines.append("Nominal rates are guesses, which may be wrong by a factor of three: a plan with a pilot measures.")
    if available and plan.machine_memory_bytes > available:
        lines.append("That is more memory than is available: take fewer workers (--num-cpus), or a smaller replay_capacity.")
    return lines


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'s' if count > 1 else ''}"


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.2g}"


def _duration(hours: float) -> str:
    minutes = round(hours * 60)
    if minutes < 2:
        return f"{hours * 3600:.0f} seconds"
    return f"{minutes} minutes" if minutes < 120 else f"{hours:,.1f} hours" if hours < 48 else f"{hours / 24:,.1f} days"


def _bytes(count: int) -> str:
    for unit, size in (("GB", 2**30), ("MB", 2**20)):
        if count >= size:
            return f"{count / size:,.1f} {unit}" if unit == "GB" else f"{count / size:,.0f} {unit}"
    return f"{count / 1024:,.0f} kB"
