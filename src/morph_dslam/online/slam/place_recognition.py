"""Which keyframes show the place that an image shows: a bag of binary words, trained from the map itself.

Descriptors are assigned to the nearest of some hundred words, and images are compared by how often each word
occurs in them, rare words counting more (Sivic and Zisserman 2003; binary words as in Gálvez-López and Tardós
2012). The words are cluster centres by k-majority (Grana et al. 2013): bits that most members have.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.online.slam.descriptors import Descriptors, Indices
from morph_dslam.online.slam.rigid_map import RigidMap

Array = NDArray[np.float64]

N_WORDS = 400
#: Descriptors that words are trained from, and rounds of clustering.
N_TRAINING, ROUNDS = 6000, 6
#: Words are trained anew when there are this many times the keyframes that they were trained from.
RETRAIN_AT = 1.5


@njit(cache=True, nogil=True)
def bit_counts(descriptors, members, n_words):
    """How many of each word's members (n,), descriptors (n, 32), have each bit (w, 256).

    numpy's sums over groups would hold the interpreter for milliseconds.
    """
    counts = np.zeros((n_words, 8 * descriptors.shape[1]), dtype=np.int64)
    for row in range(len(descriptors)):
        for column in range(descriptors.shape[1]):
            for bit in range(8):
                set_bit = (descriptors[row, column] >> (7 - bit)) & 1
                counts[members[row], 8 * column + bit] += set_bit
    return counts


class Vocabulary:
    """Binary words.

    Attributes
    ----------
    words : (w, 32).
    """

    def __init__(self, descriptors: Descriptors, n_words: int = N_WORDS, seed: int = 0) -> None:
        """Cluster descriptors (n, 32); the same ones give the same words."""
        rng = np.random.default_rng(seed)
        order = rng.permutation(len(descriptors))[:N_TRAINING]
        sample = descriptors[order]
        self.words = sample[:n_words].copy()
        for _ in range(ROUNDS):
            members = self.assign(sample)
            counts = np.bincount(members, minlength=len(self.words))
            majority = 2 * bit_counts(sample, members, len(self.words)) > counts[:, None]
            self.words[counts > 0] = np.packbits(majority[counts > 0], axis=1)

    def assign(self, descriptors: Descriptors) -> Indices:
        """The nearest word (n,) of each descriptor (n, 32)."""
        matches = cv2.BFMatcher(cv2.NORM_HAMMING).match(descriptors, self.words)
        return np.array([match.trainIdx for match in matches], dtype=np.int64)

    def histogram(self, descriptors: Descriptors) -> Array:
        """How often each word (w,) occurs, as parts of one."""
        counts = np.bincount(self.assign(descriptors), minlength=len(self.words)) if len(descriptors) else 0.0
        return np.broadcast_to(counts / max(len(descriptors), 1), len(self.words)).astype(float)


class PlaceIndex:
    """The keyframes of a map by what they look like."""

    def __init__(self, rigid_map: RigidMap) -> None:
        self._map = rigid_map
        self._vocabulary: Vocabulary | None = None
        self._n_trained = 0
        self._histograms = np.empty((0, N_WORDS))

    def update(self) -> None:
        """Take in the keyframes that are new."""
        keyframes = self._map.keyframes
        if self._vocabulary is None or len(keyframes) >= RETRAIN_AT * self._n_trained:
            self._vocabulary = Vocabulary(np.concatenate([k.descriptors for k in keyframes]))
            self._n_trained = len(keyframes)
            self._histograms = np.empty((0, len(self._vocabulary.words)))
        new = [self._vocabulary.histogram(k.descriptors) for k in keyframes[len(self._histograms) :]]
        self._histograms = np.vstack([self._histograms, *new])

    def similarities(self, descriptors: Descriptors) -> Array:
        """How much an image with these descriptors (k, 32) resembles each keyframe (n,), from 0 to 1."""
        assert self._vocabulary is not None
        frequency = (self._histograms > 0.0).mean(axis=0)
        weights = np.log((1.0 + len(self._histograms)) / (1.0 + frequency * len(self._histograms))) + 0.1
        seen = weights * self._vocabulary.histogram(descriptors)
        known = weights * self._histograms
        common = np.minimum(known, seen).sum(axis=1)
        # Keyframes that were taken out resemble nothing.
        common[[not len(keyframe.descriptors) for keyframe in self._map.keyframes]] = 0.0
        return common / np.maximum(np.maximum(known.sum(axis=1), seen.sum()), 1e-12)
