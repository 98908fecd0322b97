"""Car detection from camera and lidar on KITTI: files, geometry, ground planes, evaluation."""
