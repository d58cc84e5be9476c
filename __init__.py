"""Wildsmoke: from one video of smoke to a moving 3D smoke asset. The entry of the Blender extension.

Nothing of Blender is imported before register(), so that the checkout can be imported without Blender.
"""


def register() -> None:
    from . import addon

    addon.register()


def unregister() -> None:
    from . import addon

    addon.unregister()
