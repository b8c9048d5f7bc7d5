"""Pinocchio's Jacobians of contacts that roll on the ground."""

from __future__ import annotations

import numpy as np
from synthetic import Array, Oracle

from torchid.sensing import Contact


class RollingOracle(Oracle):
    """An oracle whose contacts roll: forces act at c - r n, and a wrench is what a sensor at c reads of them.

    Its Jacobian of a contact with a scalar sensor is along two directions across the ground's normal, then along it.
    """

    contacts: dict[str, Contact] = {}
    normals: dict[str, Array] = {}
    mounting: Array = np.eye(3)

    def jacobian(self, q: Array, frame: str) -> Array:
        J = super().jacobian(q, frame)
        contact = self.contacts.get(frame, Contact(frame, "flat"))
        normal = self.normals.get(frame, unit(np.array(contact.normal)))
        n = (
            (self.mounting @ self.pose(q, frame)[0]).transpose(0, 2, 1)
            @ np.broadcast_to(normal, (len(q), 3))[..., None]
        )[..., 0]
        across = np.linalg.svd(n[:, :, None])[0].transpose(0, 2, 1)[:, 1:]
        ground = np.concatenate([across, n[:, None]], axis=1)
        if contact.kind == "line":
            along = "xyz".index(contact.line_axis)
            n[:, along] = 0.0
            n = unit(n)
        moment = np.cross(-contact.radius * n[:, None], np.eye(3))  # of a unit force along each axis, about c
        if contact.kind == "line":  # the ground has no moment about the axis; those across it are unknowns of their own
            moment[..., [axis for axis in range(3) if axis != along]] = 0.0
        J[:, :3] += moment @ J[:, 3:]
        if contact.along_normal:  # components of its force are then along the axes of the ground
            J[:, :3] = ground @ J[:, :3]
        return J


def unit(x: Array) -> Array:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)
