"""Which frame is next: of every capture in order, several at once where they do not wait for one another.

Frames wait where a rack is looked for until one frame names it, and in sessions with hints that say `previous`. So the
rows are the same for every number of processes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from tubepose.batch.jobs import MOST_ASKED, Job, UnnamedJob
from tubepose.batch.record_store import Store
from tubepose.batch.tasks import Earlier, Ended, KnownTurn, NamedRack, Outcome, Task


@dataclass(slots=True, eq=False)
class _Progress:
    """How far a capture is."""

    number: int
    job: Job | UnnamedJob
    chain: _Chain
    next: int = 0
    end: int | None = None
    named: NamedRack | None = None
    asked: int = 0
    reason: str = ""
    busy: set[int] = field(default_factory=set)
    done: dict[int, str] = field(default_factory=dict)
    problems: dict[int, str] = field(default_factory=dict)

    @property
    def waits(self) -> bool:
        """Whether each frame waits for the one before."""
        return self.chain.in_order or (isinstance(self.job, UnnamedJob) and self.named is None)

    @property
    def over(self) -> bool:
        return self.end is not None and not self.busy

    @property
    def open(self) -> bool:
        """Whether a frame can be handed out."""
        return self.end is None and not (self.waits and self.busy)

    def cut(self, end: int) -> None:
        self.end = end if self.end is None else min(self.end, end)


@dataclass(slots=True, eq=False)
class _Chain:
    """Captures that are done one after the other: one, or all of a session with hints that say `previous`."""

    in_order: bool
    known: KnownTurn | None = None
    used: list[object] = field(default_factory=list)
    captures: list[_Progress] = field(default_factory=list)
    at: int = 0


class Schedule:
    """Hands out frames and takes in what became of them; frames that have a record already are not handed out.

    Args:
        jobs: All of the batch.
        store: The records.
        numbers: The jobs to do; by default all.
        on_done: Called after each frame and each problem with how many there were, and how many are expected.
    """

    def __init__(
        self,
        jobs: Sequence[Job | UnnamedJob],
        store: Store,
        numbers: Sequence[int] | None = None,
        on_done: Callable[[int, int], None] | None = None,
    ) -> None:
        self.store = store
        self.done = 0
        self.expected = 0
        self.on_done = on_done
        self._chains: list[_Chain] = []
        groups: dict[str, _Chain] = {}
        following = {job.session for job in jobs if job.previous}
        for number in range(len(jobs)) if numbers is None else numbers:
            job = jobs[number]
            chain = groups.get(job.session) if job.session in following else None
            if chain is None:
                chain = _Chain(job.session in following)
                self._chains.append(chain)
                if chain.in_order:
                    groups[job.session] = chain
            chain.captures.append(_Progress(number, job, chain))
        self._captures = sorted((one for chain in self._chains for one in chain.captures), key=lambda one: one.number)
        self._by_number = {one.number: one for one in self._captures}
        self._waiting = list(reversed(self._chains))
        self._begun: list[_Chain] = []
        self.expected = len(self._captures)

    @property
    def over(self) -> bool:
        """Whether every frame was done or has its problem."""
        return not self._waiting and not self._begun

    def take(self, last: int | None = None) -> Task | None:
        """The next frame for a process; None where all wait for others, or all are done.

        Args:
            last: The job that the process did before: it has that capture open.
        """
        while True:
            progress = self._choose(last)
            if progress is None:
                return None
            task = self._task(progress)
            last = progress.number
            if progress.next - 1 == self.store.ended(progress.number):
                self.finish(task, Outcome(Ended.NO_FRAME))
                continue
            record = self.store.read(task.key)
            if record is None:
                return task
            self.finish(task, record.outcome)

    def finish(self, task: Task, outcome: Outcome) -> None:
        """Take in what became of a task."""
        progress = self._by_number[task.number]
        progress.busy.discard(task.position)
        if outcome.problem:
            progress.problems[task.position] = outcome.problem
        if outcome.ended is Ended.DONE:
            self._learn(progress, task, outcome)
        elif outcome.ended is Ended.NO_FRAME:
            progress.cut(task.position)
        elif outcome.ended is Ended.CAPTURE_FAILED:
            progress.cut(task.position + 1)
        if outcome.ended is not Ended.NO_FRAME:
            self.done += 1
        self._close(progress)
        busy = sum(bool(chain.captures[chain.at].busy) for chain in self._begun)
        self.expected = max(self.expected, self.done + busy + sum(len(chain.captures) for chain in self._waiting))
        if self.on_done is not None and outcome.ended is not Ended.NO_FRAME:
            self.on_done(self.done, self.done if self.over else self.expected)

    def revive(self, task: Task) -> None:
        """Take in a frame whose record is there although its process did not come to say so."""
        record = self.store.read(task.key)
        assert record is not None
        self.finish(task, record.outcome)

    def _learn(self, progress: _Progress, task: Task, outcome: Outcome) -> None:
        progress.done[task.position] = task.key
        if outcome.problem:
            progress.cut(task.position + 1)
        if isinstance(progress.job, UnnamedJob) and progress.named is None:
            progress.named = outcome.named
            if outcome.named is None:
                progress.asked += 1
                progress.reason = progress.reason or outcome.reason
                if progress.asked == MOST_ASKED:
                    progress.cut(task.position + 1)
        chain, hint = progress.chain, progress.job.hint
        if outcome.turn is not None:
            chain.known = outcome.turn
            if hint is not None:
                chain.used.append(hint)

    def _close(self, progress: _Progress) -> None:
        """What is to be done when a capture is over."""
        if not progress.over:
            return
        assert progress.end is not None
        if isinstance(progress.job, UnnamedJob) and progress.named is None and not progress.problems:
            path = progress.job.capture.path
            reason = progress.reason or "no frame to find the rack in"
            progress.problems[progress.end] = f"{path}: {reason}"
        whole = all(position in progress.done for position in range(progress.end))
        if whole and not progress.problems:
            self.store.end(progress.number, progress.end)
        chain = progress.chain
        while chain.at < len(chain.captures) and chain.captures[chain.at].over:
            chain.at += 1
        if chain.at == len(chain.captures):
            self._begun = [one for one in self._begun if one is not chain]

    def _choose(self, last: int | None) -> _Progress | None:
        current = self._by_number.get(last) if last is not None else None
        if current is not None and current.open and current.chain.captures[current.chain.at] is current:
            return current
        if current is not None and current.chain in self._begun:  # the next capture of its session
            following = current.chain.captures[current.chain.at]
            if following.open:
                return following
        if self._waiting:
            chain = self._waiting.pop()
            self._begun.append(chain)
            return chain.captures[0]
        shared = [chain.captures[chain.at] for chain in self._begun if chain.captures[chain.at].open]
        return min(shared, key=lambda one: (len(one.busy), one.number), default=None)

    def _task(self, progress: _Progress) -> Task:
        position, chain, hint = progress.next, progress.chain, progress.job.hint
        earlier = Earlier()
        if progress.job.previous:
            earlier = Earlier(chain.known, any(hint is used for used in chain.used))
        task = Task(progress.number, position, "", progress.named, earlier)
        progress.next += 1
        progress.busy.add(position)
        return replace(task, key=self.store.key(task))

    def results(self) -> Iterator[tuple[int, list[str], list[str]]]:
        """Of every job its number, the keys of its records in order up to its end, and its problems in order."""
        for one in self._captures:
            end = one.end if one.end is not None else one.next
            keys = [one.done[position] for position in sorted(one.done) if position < end]
            yield one.number, keys, [line for position, line in sorted(one.problems.items()) if position <= end]

    @property
    def has_problems(self) -> bool:
        """Whether a frame or a capture could not be done."""
        return any(one.problems for one in self._captures)

    @property
    def problems(self) -> list[str]:
        """One line per frame or capture that could not be done, in order."""
        return [line for _, _, lines in self.results() for line in lines]
