"""Mosaics of every connected block of images: the largest first, then of what it left out."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rdstitch.choices import Purpose
from rdstitch.errors import InputError, OutputError, RdstitchError, RegistrationError
from rdstitch.inputs.find import FoundImages
from rdstitch.inputs.frame import Frame, Images
from rdstitch.inputs.selection import selected
from rdstitch.inputs.times import with_times
from rdstitch.options.files_beside import NOTHING_BESIDE, FilesBeside
from rdstitch.options.stitch_options import StitchOptions
from rdstitch.pipeline.outputs.output_files import file_of_part
from rdstitch.pipeline.recipes import stitch_images
from rdstitch.pipeline.run import RecipeInput, Run
from rdstitch.results.messages import Message
from rdstitch.results.registration import Registration
from rdstitch.results.stitch_result import StitchResult
from rdstitch.system.native_threads import one_native_thread
from rdstitch.system.progress import Progress, silent
from rdstitch.system.temporary_folder import TemporaryFolder
from rdstitch.verification.verdict import RefusedError


@one_native_thread()
def mosaic_blocks(
    inputs: Images,
    output: str | Path,
    options: StitchOptions | None = None,
    *,
    every: int | None = None,
    progress: Progress = silent,
    beside: FilesBeside = NOTHING_BESIDE,
) -> tuple[StitchResult, ...]:
    """Stitch every block of images that overlap: the largest, and again of what that left out, while images overlap.

    Parameters
    ----------
    inputs, options, every, progress, beside
        As for :func:`rdstitch.mosaic`; ``beside``, the camera file and the reference image are for the largest block.
    output : path
        Of the largest block; ``field.tif`` is followed by ``field-2.tif`` and so on.

    Returns
    -------
    tuple of StitchResult
        The largest block first, without which there is an error. Images that are in no block are named in it.
    """
    file = Path(output)
    given = RecipeInput.of(inputs, options, Purpose.MOSAIC, every)
    whole = Run.of(given, file, beside, progress)
    # All are published together, once the cache is gone; what was found of images and pairs serves the next block.
    with given.find_images(file) as images, whole.outputs, TemporaryFolder() as cache:
        images = replace(images, frames=list(with_times(images.frames, whole.options.timestamps)))
        options = replace(whole.options, timestamps=None)
        frames = selected(images.frames, options.exclude, options.include_only)
        names = [file, *(file_of_part(file, k) for k in range(2, len(frames) // 2 + 1))]
        run = whole.of_part(file, options, whole.beside, cache)
        results = [stitch_images(replace(images, outputs=[], notes=()), run, more_images=names[1:])]
        refused: list[Message] = []
        frames = _not_used(frames, results[0].registration)
        options = _for_further_blocks(options)
        while len(frames) > 1:
            run = whole.of_part(names[len(results)], options, temporary_cache=cache)
            try:
                with whole.outputs.together():
                    result = stitch_images(FoundImages(frames, [], images.containers), run)
            except RefusedError as error:
                registration = error.registration
                refused.append(Message(f"a further block of {registration.alignment.used.sum()} images: {error}"))
            except (RegistrationError, InputError):
                break  # that the rest does not overlap, or cannot be read, the first block has said
            except OutputError:
                raise
            except RdstitchError as error:
                refused.append(Message(f"there are no blocks after the {len(results)} first: {error}"))
                break
            else:
                registration = result.registration
                results.append(result)
            frames = _not_used(frames, registration)
    return _naming_left_out_once(results, [*images.messages, *refused])


def _not_used(frames: Sequence[Frame], registration: Registration) -> list[Frame]:
    """The frames that a registration does not use."""
    pairs = zip(registration.sources, registration.alignment.used, strict=True)
    used = [source.frame or Frame(source.path) for source, is_used in pairs if is_used]
    done = {(frame.path, frame.number) for frame in used}
    return [frame for frame in frames if (frame.path, frame.number) not in done]


def _for_further_blocks(options: StitchOptions) -> StitchOptions:
    """The options without what concerns the first block alone: camera file, reference image, patterns of names."""
    lines = options.composite.straighten if options.composite.straighten in ("off", "auto") else "off"
    composite = replace(options.composite, rectangle=None, straighten=lines)
    return replace(options, save_camera=None, reference=None, composite=composite, exclude=(), include_only=())


def _naming_left_out_once(results: Sequence[StitchResult], messages: Sequence[Message]) -> tuple[StitchResult, ...]:
    """The blocks; the first names the images that are in none, and has the messages on all."""
    placed = {str(source.path) for result in results for source in result.placed.sources}
    named = []
    for block, result in enumerate(results):
        kept = [
            message
            for message in result.messages
            if message.severity != "left out" or (block == 0 and not placed.issuperset(message.images))
        ]
        more = messages if block == 0 else ()
        named.append(replace(result, registration=replace(result.registration, messages=(*kept, *more))))
    return tuple(named)
