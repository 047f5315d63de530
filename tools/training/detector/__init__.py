"""The detector of drones: YOLOX-nano, begun with weights of COCO, taught with drones before real photographs."""
