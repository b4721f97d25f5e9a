"""Second-order structure of an image: the Hessian of a Gaussian and its eigenvalues."""

from __future__ import annotations

import cv2
import numpy as np


def gaussian_kernels(sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sampled Gaussian and its first and second derivative, float32, +-4 sigma; exact on parabolas
    (sum x^2 g'' / 2 = 1)."""
    r = int(np.ceil(4 * sigma))
    x = np.arange(-r, r + 1)
    g = np.exp(-0.5 * (x / sigma) ** 2)
    g /= g.sum()
    g1 = x * g / (x * x * g).sum()
    g2 = (x * x / sigma**2 - 1) * g
    g2 -= g2.mean()
    g2 *= 2 / (x * x * g2).sum()
    return tuple(np.ascontiguousarray(k, np.float32) for k in (g, g1, g2))


def hessian(image: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """I_uu, I_uv, I_vv of the (H, W) float32 image smoothed with a Gaussian of `sigma` px."""
    g, g1, g2 = gaussian_kernels(sigma)
    border = cv2.BORDER_REFLECT
    return (cv2.sepFilter2D(image, cv2.CV_32F, g2, g, borderType=border),
            cv2.sepFilter2D(image, cv2.CV_32F, g1, g1, borderType=border),
            cv2.sepFilter2D(image, cv2.CV_32F, g, g2, borderType=border))


def eigenvalues(uu: np.ndarray, uv: np.ndarray, vv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The eigenvalues l1, l2 of the 2x2 Hessian of each pixel in closed form, |l1| <= |l2|."""
    mean = 0.5 * (uu + vv)
    half = np.sqrt((0.5 * (uu - vv)) ** 2 + uv * uv)
    low, high = mean - half, mean + half
    swap = mean < 0                      # then `low` is the larger in magnitude
    return np.where(swap, high, low), np.where(swap, low, high)
