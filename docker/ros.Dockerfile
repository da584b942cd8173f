# syntax=docker/dockerfile:1
# The ROS 2 node and a bridge to Foxglove on ROS 2 Jazzy, for amd64 and arm64. Build from the repository's root:
#   docker build -f docker/ros.Dockerfile -t ultragray:ros .
#   docker run --network host ultragray:ros ros2 launch ultragray_ros ultragray.launch.xml address:=localhost:50051 foxglove:=true
# docs/howto/ros.md says what its topics and parameters are; compose.yaml runs it beside the service (profile ros).
ARG ROS_IMAGE=ros:jazzy-ros-base
FROM ${ROS_IMAGE}
RUN apt-get update \
 && apt-get install --no-install-recommends -y python3-venv "ros-${ROS_DISTRO}-foxglove-bridge" \
 && rm -rf /var/lib/apt/lists/*
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /source
COPY proto proto
COPY client client
COPY ros ros
# The messages of this release of ROS are compiled against NumPy 1. The secret `pip` is a pip.conf, as in Dockerfile.
RUN --mount=type=secret,id=pip,target=/etc/pip.conf \
    python3 -m venv --system-site-packages /opt/ultragray \
 && /opt/ultragray/bin/pip install 'numpy<2' ./proto ./client ./ros
ENV PATH=/opt/ultragray/bin:$PATH AMENT_PREFIX_PATH=/opt/ultragray PYTHONUNBUFFERED=1 HOME=/tmp ROS_LOG_DIR=/tmp/ros
# Nodes of the host would take the network of the container for their own, and wait for images in a shared memory that is not theirs.
ENV FASTDDS_BUILTIN_TRANSPORTS=UDPv4
USER 10001:10001
WORKDIR /tmp
CMD ["ros2", "launch", "ultragray_ros", "ultragray.launch.xml", "foxglove:=true"]
