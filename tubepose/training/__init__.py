"""A detector that learns from labware files: labelled pictures by rendering, training, and the model's file."""
