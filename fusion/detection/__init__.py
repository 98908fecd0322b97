"""Car detection from camera and lidar on KITTI: files, geometry, maps, boxes, evaluation."""
