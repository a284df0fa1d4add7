"""What a map is built from: folders of images, rigs and HoloLens recordings, checked before any work starts."""
