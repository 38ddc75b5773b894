"""One camera as a dozen programs write it."""

import json

import numpy as np

K = [[365.5, 0.0, 255.5], [0.0, 366.5, 205.0], [0.0, 0.0, 1.0]]
DISTORTION = [0.09, -0.27, 0.0, 0.001, 0.095]
OURS = f"width: 512\nheight: 424\nK: {K}\ndistortion: {DISTORTION}\n"
RECORDING = f"camera: {{width: 512, height: 424, K: {K}, distortion: {DISTORTION}}}\n"
ROS = f"""
image_width: 512
image_height: 424
camera_matrix: {{rows: 3, cols: 3, data: {np.ravel(K).tolist()}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {DISTORTION}}}
"""
JSON = json.dumps({"width": 512, "height": 424, "camera_matrix": K, "dist_coeffs": [DISTORTION]})
OPENCV = f"""%YAML:1.0
---
cameraMatrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {np.ravel(K).tolist()}
"""
NUMBERS = f"{{fx: 365.5, fy: 366.5, cx: 255.5, cy: 205, distortion: {DISTORTION}}}"
