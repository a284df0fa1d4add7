"""Make recordings, photos and maps' images from rendered scenes, so that everything runs without a robot."""
