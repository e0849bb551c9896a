"""Richardson-Lucy deconvolution of images by the PSFs of a bank, at the price of its Fourier transforms.

One iteration is ``x <- x * H^T(m y / H x) / w`` with ``w = max(H^T m, eps)`` (Bertero and Boccacci, "A simple method
for the reduction of boundary effects in the Richardson-Lucy approach to image deconvolution", A&A 437, 369, 2005):
``y`` is the image, ``m`` is 1 where it was observed, and the estimate ``x`` lives on a domain that is larger than the
image by the reach of the PSF, because light from outside falls into the frame. The same weights serve image borders,
saturated pixels and regions.

What makes it quick:

* real transforms in single precision, at lengths that factor well;
* the two-dimensional transforms are taken apart. Columns are transformed forth, multiplied by the OTF and transformed
  back while a block of them is in the processor's cache; rows likewise around the division and the update. Everything
  happens in place in one buffer, four sweeps over memory an iteration;
* the first iteration from a constant estimate is ``H^T(m y) / w``: the image's own transform serves every depth;
* transforms of image and mask are made once and shared by all depths, OTFs are made once and shared by all images.

Memory: 20 bytes per pixel of the extended domain and a further 8 per image pixel, whatever the number of depths.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from workbench.compiled import compiled

Borders = Literal["weighted", "dark"]
"""``weighted``: light from outside the frame is accounted for. ``dark``: beyond the frame is black, as in plain
Richardson-Lucy; rings at the borders and is here for comparison."""

FloatImage = NDArray[np.float32]
Spectrum = NDArray[np.complex64]

_COLUMN_BLOCK = 128
_ROW_BLOCK_PIXELS = 1 << 18
_RELATIVE_FLOOR = 1e-6
"""A prediction below this fraction of the brightest pixel is rounding of the transforms, not light."""


@dataclass(frozen=True, slots=True)
class Kernel:
    """One PSF, ready for use: its OTF and what border pixels weigh under it.

    Attributes
    ----------
    otf
        complex64 (P, Q // 2 + 1), transform of the PSF with its centre at the origin.
    inverse_weight
        float32 (P, Q), ``1 / max(H^T m, eps)``; None where borders are dark.
    """

    otf: Spectrum
    inverse_weight: FloatImage | None

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self.otf.nbytes + (0 if self.inverse_weight is None else self.inverse_weight.nbytes)


@dataclass(frozen=True, slots=True)
class PreparedImage:
    """One plane of an image with what all depths share of it.

    Attributes
    ----------
    plane
        float32 (H, W), negative noise and masked pixels set to zero.
    spectrum
        complex64 (P, Q // 2 + 1), its transform on the extended domain.
    """

    plane: FloatImage
    spectrum: Spectrum


class Deconvolver:
    """Richardson-Lucy for all images of one size; safe to use from several threads.

    Parameters
    ----------
    shape
        (H, W) of the images, pixels.
    max_psf_size
        Largest side of any PSF that will be used, pixels.
    mask
        bool (H, W), True where the image was observed; None for everywhere.
    borders
        See :data:`Borders`.
    weight_floor
        ``eps`` of the weights: pixels that the image hardly sees (as a fraction of a full view) grow no faster
        than this allows.
    workers
        Threads.

    Raises
    ------
    ValueError
        If the mask doesn't fit the shape or is given with dark borders.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        max_psf_size: int,
        *,
        mask: NDArray[np.bool_] | None = None,
        borders: Borders = "weighted",
        weight_floor: float = 1e-2,
        workers: int = 1,
    ) -> None:
        if mask is not None and mask.shape != shape:
            raise ValueError(f"mask is {mask.shape}, images are {shape}")
        if mask is not None and borders == "dark":
            raise ValueError("a mask needs weighted borders")
        self.shape = shape
        self.max_psf_size = max_psf_size
        self.domain = (_fast_length(shape[0], max_psf_size), _fast_length(shape[1], max_psf_size))
        self.borders = borders
        self.workers = workers
        self._mask = mask
        self._weight_floor = weight_floor
        observed = np.ones(shape, np.float32) if mask is None else mask.astype(np.float32)
        self._mask_spectrum = self._transform(observed)

    def prepare(self, plane: NDArray[np.floating]) -> PreparedImage:
        """Transform one plane (H, W) once for all depths.

        Raises
        ------
        ValueError
            If the plane has another shape.
        """
        if plane.shape != self.shape:
            raise ValueError(f"image is {plane.shape}, this deconvolver is for {self.shape}")
        clean = np.maximum(np.asarray(plane, np.float32), np.float32(0))
        if self._mask is not None:
            clean *= self._mask
        return PreparedImage(clean, self._transform(clean))

    def kernel(self, psf: NDArray[np.floating]) -> Kernel:
        """OTF and weights of a PSF (K, K'): odd sides, origin at the centre; negative noise is cut, the sum made 1.

        Raises
        ------
        ValueError
            If a side is even or larger than ``max_psf_size``, or nothing of the PSF is positive.
        """
        if any(side % 2 == 0 for side in psf.shape) or max(psf.shape) > self.max_psf_size:
            raise ValueError(f"a PSF of {psf.shape} pixels: sides must be odd and at most {self.max_psf_size}")
        positive = np.maximum(np.asarray(psf, np.float32), np.float32(0))
        total = float(positive.sum(dtype=np.float64))
        if not total > 0:
            raise ValueError("a PSF without any light")
        padded = np.zeros(self.domain, np.float32)
        padded[: psf.shape[0], : psf.shape[1]] = positive / np.float32(total)
        padded = np.roll(padded, (-(psf.shape[0] // 2), -(psf.shape[1] // 2)), axis=(0, 1))
        otf: Spectrum = scipy.fft.rfft2(padded, workers=self.workers)
        if self.borders == "dark":
            return Kernel(otf, None)
        weight = scipy.fft.irfft2(self._mask_spectrum * np.conj(otf), s=self.domain, workers=self.workers)
        np.maximum(weight, np.float32(self._weight_floor), out=weight)
        return Kernel(otf, np.reciprocal(weight, out=weight))

    def observed_fraction(self, kernel: Kernel) -> FloatImage:
        """float32 (H, W): part of the light of each pixel of the scene that falls on observed pixels, at least eps."""
        if kernel.inverse_weight is None:
            return np.ones(self.shape, np.float32)
        return np.reciprocal(kernel.inverse_weight[: self.shape[0], : self.shape[1]])

    def richardson_lucy(
        self,
        image: PreparedImage | NDArray[np.floating],
        psf: Kernel | NDArray[np.floating],
        iterations: int = 20,
    ) -> FloatImage:
        """Deconvolve one plane, starting from a constant.

        Parameters
        ----------
        image
            (H, W) linear intensities, or what :meth:`prepare` made of them. Negative values count as zero.
        psf
            (K, K') PSF, or what :meth:`kernel` made of it.
        iterations
            At least 1.

        Returns
        -------
        float32 (H, W), same unit as the image.

        Raises
        ------
        ValueError
            For fewer than one iteration and shapes that don't fit.
        """
        if iterations < 1:
            raise ValueError(f"{iterations} iterations: at least 1 is needed")
        prepared = image if isinstance(image, PreparedImage) else self.prepare(image)
        kernel = psf if isinstance(psf, Kernel) else self.kernel(psf)
        peak = float(prepared.plane.max(initial=0.0))
        if peak == 0.0:
            return np.zeros(self.shape, np.float32)
        floor = np.float32(_RELATIVE_FLOOR * peak)
        with _threads(self.workers) as run:
            if kernel.inverse_weight is None:
                sweep = _Sweep(self.shape, self.domain, kernel, self._mask_spectrum.copy(), run)
                sweep.estimate[:, : self.shape[1]] = peak
                sweep.spectrum *= np.float32(peak)
                done = 0
            else:
                sweep = _Sweep(self.shape, self.domain, kernel, prepared.spectrum.copy(), run)
                sweep.estimate[:] = 1.0
                sweep.back_project()
                sweep.update(last=iterations == 1)
                done = 1
            for iteration in range(done, iterations):
                sweep.project()
                sweep.divide(prepared.plane, floor)
                sweep.back_project()
                sweep.update(last=iteration == iterations - 1)
        return np.ascontiguousarray(sweep.estimate[: self.shape[0], : self.shape[1]])

    def _transform(self, plane: FloatImage) -> Spectrum:
        spectrum: Spectrum = scipy.fft.rfft2(plane, s=self.domain, workers=self.workers)
        return spectrum


class KernelBank:
    """Kernels of all PSFs of a bank for one deconvolver: made when first asked for, the least used dropped.

    Parameters
    ----------
    deconvolver
        Whose images the kernels are for.
    psfs
        float (D, K, K).
    max_bytes
        Memory that kernels may hold; at least one is always kept.
    """

    def __init__(self, deconvolver: Deconvolver, psfs: NDArray[np.floating], max_bytes: int = 256 << 20) -> None:
        self._deconvolver = deconvolver
        self._psfs = psfs
        self._max_bytes = max_bytes
        self._kept: OrderedDict[int, Kernel] = OrderedDict()

    def __len__(self) -> int:
        return len(self._psfs)

    def __getitem__(self, index: int) -> Kernel:
        kernel = self._kept.pop(index, None) or self._deconvolver.kernel(self._psfs[index])
        self._kept[index] = kernel
        while self.nbytes > self._max_bytes and len(self._kept) > 1:
            self._kept.popitem(last=False)
        return kernel

    @property
    def nbytes(self) -> int:
        """Bytes held now."""
        return sum(kernel.nbytes for kernel in self._kept.values())


Run = Callable[[Callable[[int, int], None], int, int], None]
"""Call a function of (start, stop) for every block of so many of so many rows or columns."""


class _Sweep:
    """The estimate and its spectrum between the sweeps of one deconvolution."""

    def __init__(
        self, shape: tuple[int, int], domain: tuple[int, int], kernel: Kernel, spectrum: Spectrum, run: Run
    ) -> None:
        self.shape = shape
        self.domain = domain
        self.kernel = kernel
        self.spectrum = spectrum
        self.run = run
        # Dark borders: nothing shines outside the frame, so its rows are all there is.
        self.rows = domain[0] if kernel.inverse_weight is not None else shape[0]
        self.estimate = np.zeros((self.rows, domain[1]), np.float32)
        self._columns_known = True
        self._row_block = max(8, _ROW_BLOCK_PIXELS // domain[1])

    def project(self) -> None:
        """H x: columns of the estimate's spectrum times the OTF, back to rows."""
        self._columns(conjugate=False)

    def back_project(self) -> None:
        """H^T of the quotient: as :meth:`project` with the conjugate OTF."""
        self._columns(conjugate=True)

    def _columns(self, conjugate: bool) -> None:
        known, self._columns_known = self._columns_known, False
        sign = np.float32(-1 if conjugate else 1)
        pairs, otf_pairs = self.spectrum.view(np.float32), self.kernel.otf.view(np.float32)

        def block(start: int, stop: int) -> None:
            columns = self.spectrum[:, start:stop]
            # The shared spectra come with their columns already transformed.
            if not known:
                self._store(columns, scipy.fft.fft(columns, axis=0, overwrite_x=True))
            _multiply(pairs, otf_pairs, start, stop, sign)
            self._store(columns, scipy.fft.ifft(columns, axis=0, overwrite_x=True))

        self.run(block, self.spectrum.shape[1], _COLUMN_BLOCK)

    @staticmethod
    def _store(columns: Spectrum, transformed: Spectrum) -> None:
        # scipy may, but need not, have worked in place.
        if not np.shares_memory(columns, transformed):
            columns[:] = transformed

    def divide(self, plane: FloatImage, floor: np.float32) -> None:
        """Image over prediction within the frame, zero outside, back to a spectrum of rows."""

        def block(start: int, stop: int) -> None:
            predicted = scipy.fft.irfft(self.spectrum[start:stop], n=self.domain[1], axis=1)
            _quotient(predicted, plane[start:stop], floor)
            self.spectrum[start:stop] = scipy.fft.rfft(predicted, axis=1)

        self.run(block, self.shape[0], self._row_block)
        self.spectrum[self.shape[0] :] = 0

    def update(self, last: bool) -> None:
        """Estimate times correction over weight, and its spectrum of rows unless this is the last."""
        weight = self.kernel.inverse_weight

        def block(start: int, stop: int) -> None:
            correction = scipy.fft.irfft(self.spectrum[start:stop], n=self.domain[1], axis=1)
            estimate = self.estimate[start:stop]
            if weight is None:
                _update_dark(estimate, correction, self.shape[1])
            else:
                _update_weighted(estimate, correction, weight[start:stop])
            if not last:
                self.spectrum[start:stop] = scipy.fft.rfft(estimate, axis=1)

        self.run(block, self.rows, self._row_block)
        self.spectrum[self.rows :] = 0


@contextmanager
def _threads(workers: int) -> Iterator[Run]:
    """A runner of blocks, on the caller's thread for one worker."""
    if workers <= 1:

        def serial(work: Callable[[int, int], None], length: int, size: int) -> None:
            for start in range(0, length, size):
                work(start, min(start + size, length))

        yield serial
        return
    with ThreadPoolExecutor(workers) as pool:

        def threaded(work: Callable[[int, int], None], length: int, size: int) -> None:
            starts = range(0, length, size)
            list(pool.map(work, starts, [min(start + size, length) for start in starts]))

        yield threaded


def _fast_length(length: int, psf_size: int) -> int:
    return int(scipy.fft.next_fast_len(length + psf_size - 1, real=True))


@compiled
def _multiply(spectrum: FloatImage, otf: FloatImage, start: int, stop: int, sign: np.float32) -> None:
    """Complex product in place of the columns from start to stop.

    On (real, imaginary) pairs of whole contiguous arrays: that vectorises, complex numbers and slices don't.
    """
    for i in range(spectrum.shape[0]):
        for j in range(start, stop):
            real = spectrum[i, 2 * j]
            imaginary = spectrum[i, 2 * j + 1]
            otf_real = otf[i, 2 * j]
            otf_imaginary = sign * otf[i, 2 * j + 1]
            spectrum[i, 2 * j] = real * otf_real - imaginary * otf_imaginary
            spectrum[i, 2 * j + 1] = real * otf_imaginary + imaginary * otf_real


@compiled
def _quotient(predicted: FloatImage, plane: FloatImage, floor: np.float32) -> None:
    width = plane.shape[1]
    for i in range(plane.shape[0]):
        for j in range(width):
            predicted[i, j] = plane[i, j] / max(predicted[i, j], floor)
        for j in range(width, predicted.shape[1]):
            predicted[i, j] = 0


@compiled
def _update_weighted(estimate: FloatImage, correction: FloatImage, inverse_weight: FloatImage) -> None:
    zero = np.float32(0)
    for i in range(estimate.shape[0]):
        for j in range(estimate.shape[1]):
            # Rounding may turn a vanishing correction negative; an estimate never is.
            estimate[i, j] *= max(correction[i, j], zero) * inverse_weight[i, j]


@compiled
def _update_dark(estimate: FloatImage, correction: FloatImage, width: int) -> None:
    zero = np.float32(0)
    for i in range(estimate.shape[0]):
        for j in range(width):
            estimate[i, j] *= max(correction[i, j], zero)
