# Without `from __future__ import annotations`: Blender takes the annotations themselves, not their text.
"""What the user sets, kept in the .blend: the job, and a mirror of every setting of the contract's Config.

A test compares names, defaults, choices and ranges with the dataclasses of backend/contract/job.py.
"""

import dataclasses
import os
import re
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from ..backend.contract import job as contract
from ..backend.contract.errors import BackendError
from .supervisor import as_folder

PATH_SETTINGS = ("extraction.clean_plate", "extraction.garbage_matte", "extraction.smoke_mask")
_PRESET_ITEMS = (
    ("draft", "Draft", "A first look, in minutes"),
    ("preview", "Preview", "What an artist works with"),
    ("final", "Final", "As good as it gets; takes long"),
)
DEVICE_ITEMS = (
    ("auto", "Automatic", "CUDA where there is one, else the CPU"),
    ("cpu", "CPU", "Compute on the CPU"),
    ("cuda", "CUDA", "Compute on an NVIDIA GPU"),
)


class WILDSMOKE_PG_frames(bpy.types.PropertyGroup):
    """Decoding."""

    working_size: IntProperty(
        name="Size (px)",
        description="Longest side of the frames that are fitted; larger ones are reduced",
        default=192,
        min=16,
        max=8192,
        soft_max=1024,
    )
    frame_rate: FloatProperty(
        name="Frame Rate (1/s)",
        description="Frames per second; 0 takes it from the file (image sequences: 24)",
        default=0.0,
        min=0.0,
        max=1000.0,
    )


class WILDSMOKE_PG_extraction(bpy.types.PropertyGroup):
    """The smoke layer."""

    mode: EnumProperty(
        name="Source",
        description="Where the smoke's colour and opacity come from",
        items=(
            ("auto", "Automatic", "Recognise an alpha channel and smoke on black, else matte"),
            ("on_black", "On Black", "The clip shows smoke on black"),
            ("alpha", "Alpha Channel", "The clip's alpha channel is the smoke's opacity"),
            ("matte", "Matte", "Separate the smoke from its background"),
        ),
        default="auto",
    )
    clean_plate: StringProperty(
        name="Clean Plate", description="Image of the background without smoke, instead of an estimate", subtype="FILE_PATH"
    )
    garbage_matte: StringProperty(
        name="Garbage Matte", description="Image: what is black in it is never smoke", subtype="FILE_PATH"
    )
    smoke_mask: StringProperty(
        name="Smoke Mask", description="Image: what is white in it is always kept as smoke", subtype="FILE_PATH"
    )
    plate_frames: IntProperty(
        name="Plate Frames", description="Frames sampled over the clip for the clean plate", default=48, min=3, max=1000
    )
    guided_radius: FloatProperty(
        name="Edge Radius",
        description="Radius of the edge-aware filter, as a share of the longest side",
        default=0.01,
        min=0.0,
        max=0.2,
        precision=3,
        step=0.1,
    )


class WILDSMOKE_PG_cameras(bpy.types.PropertyGroup):
    """The camera, where none is given."""

    mode: EnumProperty(
        name="Source",
        description="Where the camera comes from",
        items=(
            ("auto", "Automatic", "The cameras.json where there is one, else a camera that stands still"),
            ("still", "Still", "The camera stands still"),
            ("given", "Given", "From a cameras.json; it must be there"),
        ),
        default="auto",
    )
    field_of_view_deg: FloatProperty(
        name="Field of View (°)", description="Of the clip's longer side", default=40.0, min=0.1, max=170.0
    )
    distance_m: FloatProperty(name="Distance (m)", description="From the camera to the smoke", default=10.0, min=1e-4, max=1e6)
    elevation_deg: FloatProperty(
        name="Looks Down (°)", description="How far the camera looks down on the smoke", default=0.0, min=-89.0, max=89.0
    )


class WILDSMOKE_PG_volume(bpy.types.PropertyGroup):
    """Where in depth the smoke is and how it moves."""

    use_prior: BoolProperty(
        name="Trained Prior",
        description="Ask a network trained on simulated smoke for depth and motion; else the images tell alone",
        default=True,
    )
    as_deep_as_wide: BoolProperty(
        name="As Deep as Wide",
        description="How deep smoke is says its silhouette, not the network; for cameras that stand still",
        default=False,
    )
    stride: IntProperty(
        name="Stride",
        description="Frames between the images that it compares; 0 finds it from the motion",
        default=0,
        min=0,
        max=60,
    )
    every: IntProperty(
        name="Every",
        description="Frames from one that it is asked about to the next, at most two strides; between, smoke is carried along",
        default=5,
        min=1,
        max=16,
    )
    finer: BoolProperty(
        name="Finer",
        description="Ask it about parts of the smoke, too, and keep what becomes of that on finer voxels; takes longer",
        default=True,
    )


class WILDSMOKE_PG_physical(bpy.types.PropertyGroup):
    """Position-based fluid: where the smoke moves."""

    num_particles: IntProperty(
        name="Particles", description="Physical particles in the first frame", default=1500, min=8, max=1_000_000
    )
    solver_iterations: IntProperty(
        name="Solver Iterations", description="Density projections in a substep", default=3, min=0, max=100
    )
    max_substeps: IntProperty(
        name="Substeps",
        description="A frame is split, at most so often, that no particle moves too far at once",
        default=4,
        min=1,
        max=64,
    )
    drag: FloatProperty(name="Drag (1/s)", description="Towards the surrounding air", default=0.5, min=0.0, max=1000.0)
    flow_gain: FloatProperty(
        name="Flow Gain",
        description="Share of the motion seen in the images that is taken on each frame",
        default=0.6,
        min=0.0,
        max=1.0,
    )
    correction_iterations: IntProperty(
        name="Corrections", description="Gradient steps on the image in each frame", default=4, min=0, max=1000
    )
    learn_buoyancy: BoolProperty(
        name="Learn Buoyancy", description="Fit the strength and direction of the buoyancy", default=True
    )


class WILDSMOKE_PG_visual(bpy.types.PropertyGroup):
    """Gaussians: what the smoke looks like."""

    num_particles: IntProperty(
        name="Particles", description="Visual particles that a picture shows, at most", default=6000, min=8, max=10_000_000
    )
    iterations: IntProperty(name="Iterations", description="Optimiser steps in each frame", default=6, min=0, max=10_000)
    mass_iterations: IntProperty(
        name="Mass Iterations",
        description="Multiplicative updates of the optical masses in each frame",
        default=1,
        min=1,
        max=1000,
    )
    consistency: FloatProperty(
        name="Consistency",
        description="Pull towards the optical masses that were carried from the previous frame",
        default=0.1,
        min=0.0,
        max=1.0,
    )
    color: EnumProperty(
        name="Color",
        description="Which colours are fitted",
        items=(
            ("auto", "Automatic", "Look at the clip which will do"),
            ("full", "Full", "Three channels for each particle"),
            ("one_hue", "One Hue", "The clip's one hue, brighter or darker; a little faster"),
        ),
        default="auto",
    )


class WILDSMOKE_PG_forecast(bpy.types.PropertyGroup):
    """The most likely next frames."""

    num_frames: IntProperty(
        name="Frames", description="Frames to forecast after the clip; 0 for none", default=0, min=0, max=10_000
    )
    fading: FloatProperty(
        name="Fading",
        description="How fast smoke comes to rest in the last frame, in e-folds while it goes as far as it is large; 0: never",
        default=0.3,
        min=0.0,
        max=100.0,
    )
    spreading: FloatProperty(
        name="Spreading",
        description="By how much moving smoke widens: standard deviation as a share of its way",
        default=0.1,
        min=0.0,
        max=10.0,
    )


class WILDSMOKE_PG_export(bpy.types.PropertyGroup):
    """The VDB sequence."""

    voxel_size: FloatProperty(
        name="Voxel Size (m)", description="0 takes the size that the particles carry", default=0.0, min=0.0, max=1e6, precision=4
    )
    max_voxels: IntProperty(
        name="Voxels at Most", description="Along the longest side of the volume", default=128, min=8, max=2048
    )


class WILDSMOKE_PG_published(bpy.types.PropertyGroup):
    """The published methods, where the method is one of them."""

    num_physical: IntProperty(
        name="Physical Particles", description="In the frame that shows most smoke", default=1500, min=8, max=1_000_000
    )
    num_particles: IntProperty(name="Particles", description="That a picture shows, at most", default=6000, min=8, max=10_000_000)
    physical_iterations: IntProperty(
        name="Physical Iterations", description="Optimiser steps in a frame, of the motion", default=12, min=0, max=10_000
    )
    visual_iterations: IntProperty(
        name="Visual Iterations", description="Optimiser steps in a frame, of the look", default=12, min=0, max=10_000
    )
    first_frame_factor: IntProperty(
        name="First Frame", description="Times as many iterations in the first frame", default=5, min=1, max=1000
    )
    solver_iterations: IntProperty(
        name="Solver Iterations", description="Density projections in a substep", default=5, min=0, max=100
    )
    buoyancy: FloatProperty(
        name="Buoyancy (m/s²)", description="Upwards; kept, or where learning starts", default=1.0, min=-1000.0, max=1000.0
    )
    surface_drag: FloatProperty(
        name="Surface Drag (1/s)", description="Where smoke borders on air", default=3.0, min=0.0, max=1000.0
    )
    viscosity: FloatProperty(
        name="Viscosity (1/s)", description="How fast neighbours' velocities become equal", default=3.0, min=0.0, max=1000.0
    )
    warm_up: IntProperty(
        name="Warm-up", description="Iterations until the frequency loss counts in full", default=500, min=0, max=1_000_000_000
    )


class WILDSMOKE_PG_config(bpy.types.PropertyGroup):
    """A mirror of contract.Config."""

    seed: IntProperty(name="Seed", description="Of all random numbers", default=0, min=0, max=2**31 - 1)
    method: EnumProperty(
        name="Method",
        description="How the particles are fitted and forecast",
        items=(
            ("default", "Default", "Wildsmoke's own"),
            ("as_published", "As Published", "The losses and the fluid of WildSmoke as printed, from one view"),
            ("fluidnexus", "FluidNexus", "The same without learned buoyancy and frequency loss"),
        ),
        default="default",
    )
    follow_clip: BoolProperty(
        name="Follow the Clip",
        description="Let the clip decide what it requires, where a setting was left alone; off, every setting stands as it is",
        default=True,
    )
    frames: PointerProperty(type=WILDSMOKE_PG_frames)
    extraction: PointerProperty(type=WILDSMOKE_PG_extraction)
    cameras: PointerProperty(type=WILDSMOKE_PG_cameras)
    volume: PointerProperty(type=WILDSMOKE_PG_volume)
    physical: PointerProperty(type=WILDSMOKE_PG_physical)
    visual: PointerProperty(type=WILDSMOKE_PG_visual)
    published: PointerProperty(type=WILDSMOKE_PG_published)
    forecast: PointerProperty(type=WILDSMOKE_PG_forecast)
    export: PointerProperty(type=WILDSMOKE_PG_export)


def _follow_preset(settings: "WILDSMOKE_PG_settings", context: bpy.types.Context) -> None:
    """Settings that the user left alone take the new preset's values; the others stay."""
    kept = changed_settings(settings.config, settings.applied_preset)
    set_config(settings.config, contract.override(contract.preset_config(settings.preset), kept))
    settings.applied_preset = settings.preset


def _suggest_output(settings: "WILDSMOKE_PG_settings", context: bpy.types.Context) -> None:
    """A first output folder beside the clip."""
    if settings.video and not settings.output_folder:
        video = Path(bpy.path.abspath(settings.video))
        name = re.sub(r"[\W_]*(%\d*d|\d+)?$", "", video.stem) or video.stem
        settings.output_folder = str(video.parent / f"{name}_wildsmoke")


def _look_at_output(settings: "WILDSMOKE_PG_settings", context: bpy.types.Context) -> None:
    from . import session

    session.look(job_folder(settings))


class WILDSMOKE_PG_settings(bpy.types.PropertyGroup):
    """One reconstruction: what contract.Job holds, and where it goes."""

    video: StringProperty(
        name="Clip",
        description="Video, folder of images, or one image of a numbered sequence",
        subtype="FILE_PATH",
        update=_suggest_output,
    )
    output_folder: StringProperty(
        name="Output", description="Folder for the job and all that it makes", subtype="DIR_PATH", update=_look_at_output
    )
    preset: EnumProperty(
        name="Preset", description="How much effort to spend", items=_PRESET_ITEMS, default="preview", update=_follow_preset
    )
    applied_preset: StringProperty(default="preview", options={"HIDDEN"})
    device: EnumProperty(
        name="Device",
        description="What to compute on",
        items=(("preferences", "As in Preferences", "What the add-on's preferences say"), *DEVICE_ITEMS),
        default="preferences",
    )
    cameras_file: StringProperty(
        name="Cameras", description="A cameras.json with the camera of every frame; empty for none", subtype="FILE_PATH"
    )
    use_frame_range: BoolProperty(name="Limit Frames", description="Fit only some frames of the clip", default=False)
    frame_start: IntProperty(name="From", description="First frame to fit; the clip's first one is 0", default=0, min=0)
    frame_stop: IntProperty(name="Before", description="First frame that is no longer fitted", default=24, min=1)
    import_when_done: BoolProperty(
        name="Import When Done", description="Bring the smoke into the scene as soon as it is finished", default=True
    )
    config: PointerProperty(type=WILDSMOKE_PG_config)


def set_config(properties: WILDSMOKE_PG_config, config: contract.Config) -> None:
    """Copy a Config into the properties."""
    for key in contract.settable_keys(config):
        group, name = _place(properties, key)
        source, _ = _place(config, key)
        setattr(group, name, getattr(source, name))


def changed_settings(properties: WILDSMOKE_PG_config, preset: str) -> dict[str, Any]:
    """The settings that differ from a preset, as Job.overrides takes them."""
    config = contract.preset_config(preset)
    changed = {}
    for key in contract.settable_keys(config):
        group, name = _place(properties, key)
        value = getattr(group, name)
        if isinstance(value, float):
            value = float(f"{value:.7g}")  # Blender keeps floats in 32 bits: 0.01 comes back as 0.0099999998
        elif key in PATH_SETTINGS and value:
            value = bpy.path.abspath(value)
        source, _ = _place(config, key)
        if value != getattr(source, name):
            changed[key] = value
    return changed


def _place(tree: Any, key: str) -> tuple[Any, str]:
    section, _, name = key.rpartition(".")
    return (getattr(tree, section) if section else tree), name


def job_folder(settings: WILDSMOKE_PG_settings) -> Path | None:
    """The output folder in full, None while there is none (or it is relative to a file that was never saved)."""
    text = settings.output_folder.strip()
    if not text or (text.startswith("//") and not bpy.data.filepath):
        return None
    return as_folder(bpy.path.abspath(text))


def make_job(settings: WILDSMOKE_PG_settings, *, device: str) -> contract.Job:
    """The job that the settings describe; device is that of the preferences. Raises BackendError."""
    if not settings.video.strip():
        raise BackendError("no_clip", "There is no clip.", hint="Choose a video or an image of a sequence.")
    cameras = settings.cameras_file.strip()
    return contract.checked_job(
        contract.Job(
            video=os.path.abspath(bpy.path.abspath(settings.video.strip())),
            preset=settings.preset,
            cameras=os.path.abspath(bpy.path.abspath(cameras)) if cameras else None,
            frame_start=settings.frame_start if settings.use_frame_range else None,
            frame_stop=settings.frame_stop if settings.use_frame_range else None,
            device=device if settings.device == "preferences" else settings.device,
            overrides=changed_settings(settings.config, settings.preset),
        )
    )


def fields_of(section: str) -> list[str]:
    """The names of a section's settings, in the contract's order."""
    return [field.name for field in dataclasses.fields(getattr(contract.Config(), section))]


CLASSES = (
    WILDSMOKE_PG_frames,
    WILDSMOKE_PG_extraction,
    WILDSMOKE_PG_cameras,
    WILDSMOKE_PG_volume,
    WILDSMOKE_PG_physical,
    WILDSMOKE_PG_visual,
    WILDSMOKE_PG_published,
    WILDSMOKE_PG_forecast,
    WILDSMOKE_PG_export,
    WILDSMOKE_PG_config,
    WILDSMOKE_PG_settings,
)
