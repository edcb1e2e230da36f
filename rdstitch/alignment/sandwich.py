"""How well the lens is known where errors are no independent noise: a sandwich estimate (Huber 1981; Cameron and Miller
2015).

The inverse of the normal equations takes errors for independent. They are not, in three ways. A keypoint that several
pairs share brings its error into all of them. Relief moves all points of a place together, in every pair of images
that shows it; see :mod:`rdstitch.alignment.relief_field`. A rolling shutter, or a lens that changes, moves all points
of an image. The influence of each correspondence on λ is added up per keypoint, or per image, and the sums are
squared.
"""

from dataclasses import replace

import numpy as np

from rdstitch.alignment.bundle_adjustment import BundleAdjuster, BundleAdjustmentResult
from rdstitch.alignment.linear_response import LinearResponse
from rdstitch.alignment.observations import Observations
from rdstitch.alignment.relief_field import ReliefField
from rdstitch.arrays import FloatArray

_SINGULAR = 1e-12
"""Least eigenvalue of a correlation matrix of parameters."""


def sandwich_covariance(adjuster: BundleAdjuster, adjusted: BundleAdjustmentResult) -> FloatArray:
    """Covariance (S', S') of the model's named parameters and the free parameters of the lens.

    In no direction less than that of independent errors, nor than where errors agree within images.

    Parameters
    ----------
    adjuster : BundleAdjuster
    adjusted : BundleAdjustmentResult
        Of this adjuster.
    """
    response, observations = LinearResponse.of(adjuster, adjusted), adjuster.observations
    influence, priors = _influence(response)
    by_images = priors + _by_images(observations, influence)
    count = int(adjuster.free.poses.sum()) + influence.shape[1]
    errors = 2 * int((response.weight > 0.0).sum())
    absorbed = errors / max(errors - count, 0.25 * errors)
    noise = absorbed * _by_keypoints(observations, influence)
    found = _at_least(priors + noise + ReliefField(response).covariance(), by_images)
    derivative = adjuster.named_parameters(adjusted.parameters.shared)[1]
    independent = replace(adjuster, overdispersion=1.0).covariance(adjusted)
    return _at_least(independent, derivative @ found @ derivative.T)


def _influence(response: LinearResponse) -> tuple[FloatArray, FloatArray]:
    """By how much each correspondence moves the shared parameters (M, S'), and their covariance by the priors alone."""
    normal = response.normal
    count = len(normal.gradient_shared)
    poses, shared = normal.responses(np.zeros((len(normal.gradient_poses), count)), -np.eye(count))
    influence, information = np.empty((len(response.weight), count)), np.zeros((count, count))
    for part in response.parts():
        change, weight = response.changes(part, poses, shared), response.weight[part.rows]
        influence[part.rows] = weight[:, None] * np.einsum("mi,mic->mc", part.errors, change)
        rows = change.reshape(-1, count)
        information += response.curvature * (rows.T * np.repeat(weight, 2)) @ rows
    return influence, shared - information


def _at_least(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """The covariance (S, S), in no direction less than another, which may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    values = np.maximum(values, _SINGULAR)
    # In the basis where the first is the identity, the larger of the two is a matter of eigenvalues.
    root, inverse = vectors * np.sqrt(values) * scale[:, None], vectors / np.sqrt(values) / scale[:, None]
    spread, directions = np.linalg.eigh(inverse.T @ least @ inverse)
    root = root @ (directions * np.sqrt(np.maximum(spread, 1.0)))
    larger: FloatArray = root @ root.T
    return larger


def _by_keypoints(observations: Observations, influence: FloatArray) -> FloatArray:
    """Covariance (S, S) when errors of correspondences that share a keypoint agree, by the influence (M, S) of each."""
    images = np.concatenate([observations.image1, observations.image2])
    own = influence.T @ influence
    shared = -own  # each correspondence is among those of two keypoints
    # One image after the other: all keypoints at once would be most of the memory of an alignment.
    for ends in np.split(np.argsort(images, kind="stable"), np.cumsum(np.bincount(images))[:-1]):
        sides, links = np.divmod(ends, len(observations))
        rows = [np.arange(observations.start[link], observations.start[link + 1]) for link in links.tolist()]
        points = [
            (observations.points2 if side else observations.points1)[own_rows]
            for side, own_rows in zip(sides.tolist(), rows, strict=True)
        ]
        if not points:
            continue
        x, y = np.concatenate(points).T
        keypoint = np.unique(x + 1j * y, return_inverse=True)[1].reshape(-1)
        sums = np.zeros((len(keypoint), influence.shape[1]))
        np.add.at(sums, keypoint, influence[np.concatenate(rows)])
        shared = shared + sums.T @ sums
    return _at_least(own, shared)


def _by_images(observations: Observations, influence: FloatArray) -> FloatArray:
    """Covariance (S, S) when errors of links that share an image agree: dyadic clusters (Aronow et al. 2015)."""
    count = 1 + int(max(observations.image1.max(), observations.image2.max()))
    link, image = np.zeros((len(observations), influence.shape[1])), np.zeros((count, influence.shape[1]))
    np.add.at(link, observations.link, influence)
    for images in (observations.image1, observations.image2):
        np.add.at(image, images, link)
    covariance: FloatArray = image.T @ image - link.T @ link
    return covariance
