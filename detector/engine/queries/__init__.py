"""What plugins may ask of the buffer: samples, poses, tuples and transforms, up to the tick and no later."""
