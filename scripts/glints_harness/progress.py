"""Progress on the terminal, with an estimate of the remaining time; plain lines where there is no terminal."""

import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

console = Console()
if not console.is_terminal:
    console.width = 130


class Display:
    """A progress bar over expected seconds, which only weigh the steps: the estimate follows the real speed."""

    def __init__(self):
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("elapsed"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(elapsed_when_finished=True),
        )
        self.bar = Progress(*columns, console=console, transient=True, speed_estimate_period=60)
        self.task = self.bar.add_task("starting", total=None)
        self.start = time.perf_counter()

    def __enter__(self):
        self.bar.start()
        return self

    def __exit__(self, *_exception):
        self.bar.stop()

    def expect(self, seconds):
        """Set the total."""
        self.bar.update(self.task, total=seconds)

    def advance(self, seconds):
        """A step is done."""
        self.bar.advance(self.task, seconds)

    def say(self, text):
        """Name the current step."""
        self.bar.update(self.task, description=text)
        if not console.is_terminal:
            console.print(f"[{time.perf_counter() - self.start:6.1f} s] {text}", markup=False, highlight=False)


class Silent:
    """No display."""

    def expect(self, seconds):
        """Nothing."""

    def advance(self, seconds):
        """Nothing."""

    def say(self, text):
        """Nothing."""
