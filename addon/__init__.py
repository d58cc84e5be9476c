"""The part inside Blender: panel, operators, preferences, and the supervision of the backend's process."""


def register() -> None:
    from . import registration

    registration.register()


def unregister() -> None:
    from . import registration

    registration.unregister()
