"""How long a job will take, how much memory, and how good it may become: before it starts, and corrected while it runs.

    work.py       what a job has to do, counted in units that do not depend on the machine
    machine.py    how fast this machine does a unit of each kind: a few seconds of the real kernels, kept in the cache folder
    predict.py    both together with the coefficients of costs.json, and the benchmark's figures of quality.json
    time_left.py  what is left of a running job

costs.json is written by `python -m benchmarks.estimates --fit`, quality.json by `python -m tools.estimate_quality`.
"""
