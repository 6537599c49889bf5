"""A film rendered in parts by several processes and encoded with ffmpeg: what is interrupted goes on where it was."""

import contextlib
import dataclasses
import hashlib
import multiprocessing
import secrets
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

import msgspec

from morph_core.durable import where_written, write_file
from studio.film.errors import DiskFullError, FilmError
from studio.film.page import Pages
from studio.film.plan import Film, Script
from studio.film.sheet import NEEDS_EXTRA, find_font
from studio.versions import versions_of

ENDINGS = (".mp4", ".gif")
PART = 24
"""Frames of one part of a film: what is lost at an interruption is at most this much of each process."""
_PLAN = "film.json"
_EXPECTED = {".mp4": 0.06, ".gif": 0.5}
"""Bytes per pixel and frame that a film and its parts take at most; GIFs are put together from parts without loss."""
_MP4 = [
    "-vf", "scale=out_color_matrix=bt709:out_range=tv,format=yuv420p", "-c:v", "libx264", "-preset", "veryfast",
    "-crf", "17", "-bf", "0", "-threads", "1", "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc",
    "bt709",
]  # fmt: skip
"""How frames are encoded; without frames that refer to later ones, parts can be joined as they are."""
_LOSSLESS = ["-c:v", "libx264rgb", "-preset", "ultrafast", "-qp", "0", "-threads", "1"]
_SAME = ["-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1"]
"""What keeps dates and versions out of a file, so that the same frames make the same bytes."""


def find_ffmpeg() -> str:
    """Return the path of ffmpeg: the one that imageio-ffmpeg brings, or the system's. FilmError where there is none."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise FilmError(NEEDS_EXTRA.format("imageio-ffmpeg, which encodes films,")) from None
    try:
        return imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise FilmError(
            "ffmpeg was not found; what still works: a still (--still FILE.svg or FILE.png). imageio-ffmpeg brings "
            "ffmpeg along on most machines; elsewhere, install it and put its path into IMAGEIO_FFMPEG_EXE"
        ) from error


@dataclass(frozen=True)
class Reel:
    """A film on its way to a file, and the folder beside that in which its parts lie until it is whole."""

    film: Film
    out: Path
    ffmpeg: str
    frames: int

    @classmethod
    def of(cls, film: Film, out: Path) -> "Reel":
        """Check that the film can be made, and make the folder of its parts, or go on with one of the same film.

        Raise FilmError where it can't be shown, encoded or written.
        """
        if out.suffix.lower() not in ENDINGS:
            raise FilmError(f'a film ends in {" or ".join(ENDINGS)}, not "{out.suffix[:20]}"')
        if not out.parent.is_dir():
            raise FilmError(f"there is no folder {out.parent} to write into")
        out = where_written(out)
        if out.exists() and not out.is_file():
            raise FilmError(f"{out} is a folder or a device; give the path of a file")
        find_font()
        ffmpeg, script = find_ffmpeg(), Script(film)
        reel = cls(film, out, ffmpeg, script.frames)
        reel._check_room()
        reel._take_up(_digest(script))
        return reel

    @property
    def folder(self) -> Path:
        """Folder of the parts."""
        return self.out.with_name(f"{self.out.name}.parts")

    @property
    def _loss(self) -> bool:
        return self.out.suffix.lower() == ".mp4"

    def parts(self) -> list[range]:
        """Return the frames of every part."""
        return [range(begin, min(begin + PART, self.frames)) for begin in range(0, self.frames, PART)]

    def path(self, part: range) -> Path:
        """Return the file of a part."""
        return self.folder / f"{part.start:06d}{'.mp4' if self._loss else '.mkv'}"

    def missing(self) -> list[range]:
        """Return the parts that have not been rendered yet."""
        return [part for part in self.parts() if not self.path(part).exists()]

    def _check_room(self) -> None:
        film, free = self.film, shutil.disk_usage(self.out.parent).free
        needed = film.width * film.height * self.frames * _EXPECTED[self.out.suffix.lower()]
        if free < needed:
            raise DiskFullError(
                f"the film may take {needed / 1e6:,.0f} MB with its parts, and {free / 1e6:,.0f} MB are free in "
                f"{self.out.parent}; make room, or give a smaller --size or fewer --seconds"
            )

    def _take_up(self, digest: str) -> None:
        """Make the folder; parts of another film that lie there are removed."""
        plan = self.folder / _PLAN
        with contextlib.suppress(OSError, msgspec.DecodeError):
            if msgspec.json.decode(plan.read_bytes()).get("digest") == digest:
                return
        self.clear()
        self.folder.mkdir(exist_ok=True)
        about = "Parts of a film that is not finished. The same command goes on from them; without them it begins anew."
        write_file(plan, msgspec.json.encode({"about": about, "digest": digest, "film": dataclasses.asdict(self.film)}))

    def clear(self) -> None:
        """Remove the parts, and their folder where nothing else is in it."""
        if self.folder.is_symlink() or not self.folder.is_dir():
            return
        for path in self.folder.iterdir():
            if path.name == _PLAN or path.suffix in (".mp4", ".mkv", ".png", ".txt", ".draft"):
                path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    # --- rendering ----------------------------------------------------------------------------------------------------

    def render(self, processes: int, on_frames: Callable[[int], None]) -> None:
        """Render the parts that are missing; `on_frames` is called with the number of frames as they are drawn.

        Raise FilmError where one can't be rendered. However it ends, whole parts stay.
        """
        missing = self.missing()
        on_frames(self.frames - sum(len(part) for part in missing))
        processes = min(processes, len(missing))
        if processes <= 1:
            self.render_parts(missing, on_frames)
            return
        context = multiprocessing.get_context("spawn")
        workers, ends = [], []
        try:
            for k in range(processes):
                end, other = context.Pipe(duplex=False)
                worker = context.Process(target=_work, args=(self, missing[k::processes], other), daemon=True)
                worker.start()
                other.close()
                workers.append(worker)
                ends.append(end)
            for said in _heard(ends):
                if isinstance(said, str):
                    raise FilmError(said)
                on_frames(said)
        finally:
            for worker in workers:
                worker.terminate()
            for worker in workers:
                worker.join()
            for draft in self.folder.glob("*.draft"):
                draft.unlink(missing_ok=True)
        if self.missing():
            raise FilmError(
                f"a process that renders the film died without a word, perhaps for want of memory; the whole parts "
                f"stay in {self.folder}, and the same command goes on from them"
            )

    def render_parts(self, parts: Sequence[range], on_frames: Callable[[int], None]) -> None:
        """Render parts in this process."""
        if not parts:
            return
        pages = Pages(Script(self.film))
        for part in parts:
            target = self.path(part)
            draft = self.folder / f"{target.stem}.{secrets.token_hex(4)}.draft"
            try:
                with self._encoder(draft) as write:
                    for frame in part:
                        write(pages.frame(frame).tobytes())
                        on_frames(1)
                draft.rename(target)
            finally:
                draft.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _encoder(self, path: Path) -> Iterator[Callable[[bytes], object]]:
        """Give a function that takes the frames of a part; they are a file once all is given."""
        film, how = self.film, [*_MP4, "-f", "mp4"] if self._loss else [*_LOSSLESS, "-f", "matroska"]
        command = [
            self.ffmpeg, "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s",
            f"{film.width}x{film.height}", "-r", str(film.fps), "-i", "-", *how, "-g", str(film.fps), *_SAME,
            _address(path),
        ]  # fmt: skip
        # In a group of its own: Ctrl-C is ours to obey, and ffmpeg ends when its frames do. In our session: one of its
        # own would have as much of the processor as any other one, however nice we are.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, process_group=0
        )
        assert process.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError):  # ffmpeg has said why
                yield process.stdin.write
            _, said = process.communicate()
        except BaseException:
            process.kill()
            process.wait()
            raise
        if process.returncode:
            raise self._why(said)

    # --- putting together ---------------------------------------------------------------------------------------------

    def join(self) -> None:
        """Put the parts together and give them the film's name; they are removed."""
        listed = "parts.txt"
        lines = [f"file '{self.path(part).name}'" for part in self.parts()]
        (self.folder / listed).write_text("ffconcat version 1.0\n" + "\n".join(lines) + "\n", encoding="ascii")
        ending = self.out.suffix.lower()
        draft = self.out.with_name(f".{self.out.name[:40]}.{secrets.token_hex(4)}{ending}")
        source, target = ["-f", "concat", "-i", listed], _address(draft)
        try:
            if ending == ".mp4":
                self._run([*source, "-c", "copy", "-movflags", "+faststart", *_SAME, target])
            else:
                palette = "palette.png"
                self._run([*source, "-vf", "palettegen=stats_mode=diff", *_SAME, palette])
                dither = "paletteuse=dither=bayer:bayer_scale=4:diff_mode=rectangle"
                self._run([*source, "-i", palette, "-filter_complex", dither, *_SAME, target])
            draft.replace(self.out)
        finally:
            draft.unlink(missing_ok=True)
        self.clear()

    def _run(self, arguments: Sequence[str]) -> None:
        """Run ffmpeg in the folder of the parts, which it is given by their plain names."""
        command = [self.ffmpeg, "-v", "error", "-y", *arguments]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False, cwd=self.folder)
        if done.returncode:
            raise self._why(done.stderr)

    def _why(self, said: bytes) -> FilmError:
        """Return in a sentence why ffmpeg has failed."""
        words = said.decode(errors="replace").strip()
        if "No space left" in words:
            return DiskFullError(
                f"the disk of {self.out.parent} is full; what is rendered stays in {self.folder}, and the same command "
                "goes on from there"
            )
        last = words.splitlines()[-1] if words else "it gave no reason"
        return FilmError(f"ffmpeg can't encode the film: {last[:300]}; what still works: a still (--still FILE.svg)")


def _address(path: Path) -> str:
    """Return a path as ffmpeg must be told it, which takes what stands before a colon for a protocol."""
    return f"file:{path.resolve()}"


def _work(reel: Reel, parts: Sequence[range], told: Connection) -> None:
    """Render parts in a process of its own; tell the frames that are drawn, or why there is no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one that started this is told, and ends it
    try:
        reel.render_parts(parts, told.send)
    except FilmError as error:
        told.send(str(error))
    finally:
        told.close()


def _heard(ends: Sequence[Connection]) -> Iterator[int | str]:
    """Yield what is told, until all have closed their ends."""
    open_ends = list(ends)
    while open_ends:
        for end in wait(open_ends):
            assert isinstance(end, Connection)
            try:
                yield end.recv()
            except EOFError:
                open_ends.remove(end)


def _digest(script: Script) -> str:
    """Return a word that differs where the frames of a film do."""
    said = hashlib.sha256(msgspec.json.encode(dataclasses.asdict(script.film)))
    said.update(msgspec.json.encode(versions_of("morph-studio", "mujoco", "numpy", "pillow", "imageio-ffmpeg")))
    for story in script.stories:
        said.update(story.phis.tobytes())
        said.update(msgspec.json.encode([*story.evaluations, story.history.record]))
    return said.hexdigest()
