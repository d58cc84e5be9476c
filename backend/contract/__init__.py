"""What both processes agree on: the job, the events, the result, the cameras, the errors, the units.

Standard library only, Python 3.11 to 3.13, so that Blender's Python can import it as it is.
"""
