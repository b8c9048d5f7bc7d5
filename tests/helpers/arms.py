"""A trunk with an IMU, turned and away from its origin, and an arm of two links."""

ARMS = """<robot name="arms"><link name="trunk"><inertial><mass value="5"/>
<inertia ixx="0.1" iyy="0.2" izz="0.15" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="imu"/><joint name="mount" type="fixed"><parent link="trunk"/><child link="imu"/>
<origin xyz="0.2 -0.1 0.3" rpy="0.3 -0.7 1.1"/></joint>
<link name="a"><inertial><mass value="1"/><origin xyz="0.1 0 0"/><inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0"
ixz="0" iyz="0"/></inertial></link><joint name="first" type="revolute"><parent link="trunk"/><child link="a"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<link name="b"><inertial><mass value="1"/><origin xyz="0 0.1 0"/><inertia ixx="0.02" iyy="0.01" izz="0.02" ixy="0"
ixz="0" iyz="0"/></inertial></link><joint name="second" type="revolute"><parent link="a"/><child link="b"/>
<axis xyz="1 0 0"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>"""
