"""RGB-D(-inertial) SLAM: options, run, evaluation, report."""
