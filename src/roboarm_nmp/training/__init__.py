"""What trainers share that is no algorithm: run folders, validation, evaluation, flags."""
