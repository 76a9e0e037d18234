"""A URDF file as the tree of its moving links: what the arm's model needs, and no more.

Geometry, meshes and the rest of the file are skipped.  What makes a model wrong without an error further on is refused
here, with the element's name: masses that are missing, inertias that no body has, loops, and magnitudes that degrees,
millimetres or grams would give.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.input_file import number_from, read_input
from jointctl.tools.configuration.config import raise_if

# beyond these a number is taken for one in another unit
LARGEST_LENGTH_m, LARGEST_MASS_kg, LARGEST_TURN_rad, LARGEST_SPEED_radps = 10.0, 1000.0, 2.0 * math.tau, 50.0
LARGEST_RPY_rad = math.tau + 1e-3  # of an origin: where one turn has everything
LEAST_REACH_m = 3.0  # from its frame, within which a body of the smallest arm may have its mass
LEAST_MASS_kg = 1e-6
MOST_LINKS = 1000
_NAMED = 5  # of many elements in one message
_ROUNDING = 1e-3  # of an inertia's largest moment, by which the digits of the file may violate what holds for bodies
MOVING = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class Pose:
    """Of a frame in another one."""

    rotation: np.ndarray  # (3, 3), columns: its axes
    offset_m: np.ndarray  # (3,)

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.rotation @ other.rotation, self.rotation @ other.offset_m + self.offset_m)


@dataclass(frozen=True)
class Mass:
    """Of one body, in a frame: mass, mass times centre, inertia about the frame's origin (3, 3)."""

    mass_kg: float
    moment_kgm: np.ndarray
    inertia_kgm2: np.ndarray

    def __add__(self, other: Mass) -> Mass:
        return Mass(
            self.mass_kg + other.mass_kg, self.moment_kgm + other.moment_kgm, self.inertia_kgm2 + other.inertia_kgm2
        )

    def seen_from(self, pose: Pose) -> Mass:
        """The same in the frame in which its own one has this pose."""
        if self.mass_kg == 0.0:
            return self
        centre = self.moment_kgm / self.mass_kg
        about_centre = self.inertia_kgm2 - self.mass_kg * _steiner(centre)
        return of_body(
            self.mass_kg, pose.rotation @ centre + pose.offset_m, pose.rotation @ about_centre @ pose.rotation.T
        )


def _steiner(centre_m: np.ndarray) -> np.ndarray:
    return np.asarray(centre_m @ centre_m * np.eye(3) - np.outer(centre_m, centre_m))


def of_body(mass_kg: float, centre_m: np.ndarray, about_centre_kgm2: np.ndarray) -> Mass:
    return Mass(mass_kg, mass_kg * centre_m, about_centre_kgm2 + mass_kg * _steiner(centre_m))


NO_MASS = Mass(0.0, np.zeros(3), np.zeros((3, 3)))


@dataclass(frozen=True)
class UrdfJoint:
    name: str
    kind: str
    parent: str  # link
    child: str  # link
    origin: Pose  # of the child's frame in the parent's
    axis: np.ndarray  # unit vector, in the child's frame
    mimics: str | None = None
    lower_rad: float | None = None  # of the limit, and of the soft one where there is one
    upper_rad: float | None = None
    velocity_max_radps: float | None = None
    effort_max_Nm: float | None = None

    @property
    def moves(self) -> bool:
        return self.kind in MOVING and self.mimics is None


@dataclass(frozen=True)
class Urdf:
    path: Path
    root: str
    links: dict[str, Mass | None]  # None: without <inertial>
    joints: tuple[UrdfJoint, ...]  # a parent's joint before those of its children
    remarks: tuple[str, ...] = ()  # what may be right and looks like another unit

    @property
    def moving(self) -> tuple[UrdfJoint, ...]:
        return tuple(joint for joint in self.joints if joint.moves)


@dataclass(frozen=True)
class Body:
    """A joint and all links that it moves as one; its frame has z along the joint's axis."""

    parent: int  # index of a body, -1 the base
    joint: UrdfJoint
    place: Pose  # of its frame at angle 0 in the parent's
    frame: Pose  # of the child link's frame in its own
    mass: Mass


def read_urdf(path: Path) -> Urdf:
    """The checked file; `ConfigurationError` with one line for each problem."""
    try:
        content = read_input(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}") from None
    parser = ElementTree.XMLParser(target=_NoDoctype(path))
    try:
        parser.feed(content)
        robot = parser.close()
    except ElementTree.ParseError as error:
        words = "; it seems to be xacro, which must be expanded first" if b"<xacro:" in content else ""
        raise ConfigurationError(f"{path}: not valid XML: {error}{words}") from None
    except (LookupError, ValueError) as error:  # of the encoding that the file says it has
        raise ConfigurationError(f"{path}: not valid XML: {error}; save it as UTF-8") from None
    if robot.tag != "robot":
        raise ConfigurationError(f"{path}: the outermost element (={robot.tag}) must be robot; is it a URDF?")
    return _Reader(path).read(robot)


class _NoDoctype(ElementTree.TreeBuilder):
    """Entities need one, in whatever encoding the file is."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path

    def doctype(self, *_: str | None) -> None:
        """Called before anything that it declares is read."""
        raise ConfigurationError(f"{self._path}: must have no DOCTYPE and no entities")


class _Reader:
    def __init__(self, path: Path) -> None:
        self._path, self._problems, self._remarks = path, list[str](), list[str]()

    def read(self, robot: ElementTree.Element) -> Urdf:
        if next((one for one in robot.iter() if "xacro" in one.tag), None) is not None:
            raise ConfigurationError(f"{self._path}: has elements of xacro, which must be expanded first")
        for one in (one for tag in ("link", "joint") for each in robot.findall(tag) for one in each.iter()):
            if odd := next((text for text in one.attrib.values() if "${" in text or "$(" in text), None):
                raise ConfigurationError(f"{self._path}: {one.tag} has {odd}: xacro, which must be expanded first")
        for tag in ("link", "joint"):
            if (count := len(robot.findall(tag))) > MOST_LINKS:
                raise ConfigurationError(f"{self._path}: {count} elements {tag}, at most {MOST_LINKS} are read")
        links = {self._name(one, "link"): one for one in robot.findall("link")}
        joints = {self._name(one, "joint"): self._joint(one) for one in robot.findall("joint")}
        for tag in ("link", "joint"):
            counts = Counter(one.get("name", "") for one in robot.findall(tag))
            for name, count in counts.items():
                if name and count > 1:
                    self._problem(f"{tag} {name} is there {count} times: each must have a name of its own")
        raise_if(self._problems)
        if robot.find("joint/safety_controller") is not None:
            self._remarks.append("of <safety_controller> the soft limits are read, k_position and k_velocity are not")
        found = Urdf(self._path, *self._tree(links, joints), tuple(self._remarks))
        raise_if(self._problems)
        return found

    def _problem(self, text: str) -> None:
        self._problems.append(f"{self._path}: {text}")

    def _name(self, element: ElementTree.Element, tag: str) -> str:
        name = element.get("name", "")
        if not name:
            self._problem(f"an element {tag} has no name")
        elif not name.isprintable():
            self._problem(f"{tag} {name}: its name must be of characters that can be printed")
        return name

    def _one(self, element: ElementTree.Element, tag: str, what: str) -> ElementTree.Element | None:
        """The child element, of which there must not be several."""
        found = element.findall(tag)
        if len(found) > 1:
            self._problem(f"{what} has {len(found)} elements {tag}, at most one is allowed")
        return found[0] if found else None

    def _numbers(
        self, element: ElementTree.Element | None, name: str, what: str, default: tuple[float, ...], largest: float,
        unit: str,
    ) -> np.ndarray:  # fmt: skip
        """Of an attribute; beyond `largest` it is taken for one in another unit."""
        text = element.get(name) if element is not None else None
        if text is None:
            return np.array(default)
        try:
            values = np.array([number_from(word) for word in text.split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) != len(default):
            count = "a number" if len(default) == 1 else f"{len(default)} numbers"
            self._problem(f"{what} (={text!r}) must be {count}")
            return np.array(default)
        if np.max(np.abs(values)) > largest:
            self._problem(f"{what} (={text!r}) must be within {largest:.4g}; {unit}?")
            return np.array(default)
        return values

    def _origin(self, element: ElementTree.Element, what: str) -> Pose:
        origin = self._one(element, "origin", what)
        for key in sorted(set() if origin is None else origin.attrib.keys() - {"xyz", "rpy"}):  # such as a quaternion
            self._problem(f"{what}: <origin> has {key}, must have xyz and rpy alone")
        zeros = (0.0, 0.0, 0.0)
        offset = self._numbers(origin, "xyz", f"{what}: xyz", zeros, LARGEST_LENGTH_m, "millimetres instead of m")
        degrees = "degrees instead of rad"
        roll, pitch, yaw = angles = self._numbers(origin, "rpy", f"{what}: rpy", zeros, LARGEST_RPY_rad, degrees)
        odd = [angle for angle in angles if abs(angle) > math.pi and angle == round(angle)]
        if odd:  # beyond half a turn and a whole number is none of pi
            self._problem(f"{what}: rpy has the angle {odd[0]:g}, more than half a turn; {degrees}?")
        elif odd := [angle for angle in angles if abs(angle) >= 1.0 and 2.0 * angle == round(2.0 * angle)]:
            turn = math.degrees(odd[0])
            self._remarks.append(f"{what}: rpy has the angle {odd[0]:g}, which is {turn:.4g} degrees; {degrees}?")
        return Pose(_turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll), offset)

    def _joint(self, element: ElementTree.Element) -> UrdfJoint:
        name, kind = element.get("name", ""), element.get("type", "")
        what = f"joint {name}"
        if kind not in (*MOVING, "fixed"):
            self._problem(f"{what}: type (={kind}) must be one of {', '.join(MOVING)}, fixed")
        axis_element = self._one(element, "axis", what)
        if axis_element is not None and axis_element.get("xyz") is None:
            self._problem(f"{what}: <axis> has no xyz")
        axis = self._numbers(axis_element, "xyz", f"{what}: axis", (1.0, 0.0, 0.0), 1e6, "no direction")
        length = float(np.linalg.norm(axis))
        if not length > 1e-6:
            if kind != "fixed":  # some programs write one there
                self._problem(f"{what}: axis must not be 0 0 0")
            axis, length = np.array([1.0, 0.0, 0.0]), 1.0
        mimic, limit = self._one(element, "mimic", what), self._one(element, "limit", what)
        largest = LARGEST_LENGTH_m if kind == "prismatic" else LARGEST_TURN_rad
        unit = "millimetres instead of m" if kind == "prismatic" else "degrees instead of rad"

        def given(of: ElementTree.Element | None, attribute: str, most: float, why: str) -> float | None:
            if of is None or of.get(attribute) is None:
                return None
            return float(self._numbers(of, attribute, f"{what}: {of.tag} {attribute}", (0.0,), most, why)[0])

        low = high = None
        if kind == "revolute":  # a continuous joint has no ends
            before, soft = len(self._problems), self._one(element, "safety_controller", what)
            lows = [given(limit, "lower", largest, unit), given(soft, "soft_lower_limit", largest, unit)]
            highs = [given(limit, "upper", largest, unit), given(soft, "soft_upper_limit", largest, unit)]
            low = max((end for end in lows if end is not None), default=None)
            high = min((end for end in highs if end is not None), default=None)
            if low is not None and high is not None and not low < high and len(self._problems) == before:
                with_soft = "" if soft is None else ", with those of <safety_controller>"
                self._problem(f"{what}: limit lower (={low:g}) must be below upper (={high:g}){with_soft}")
        return UrdfJoint(
            name=name, kind=kind, parent=self._child(element, "parent", what),
            child=self._child(element, "child", what), origin=self._origin(element, what), axis=axis / length,
            mimics=None if mimic is None else mimic.get("joint", ""),
            lower_rad=low,
            upper_rad=high,
            velocity_max_radps=given(limit, "velocity", LARGEST_SPEED_radps, f"{unit}, a second"),
            effort_max_Nm=given(limit, "effort", 1e6, "Nm"),
        )  # fmt: skip

    def _child(self, element: ElementTree.Element, tag: str, what: str) -> str:
        found = self._one(element, tag, what)
        link = "" if found is None else found.get("link", "")
        if not link:
            self._problem(f"{what}: {tag} must name a link")
        return link

    def _mass(self, name: str, element: ElementTree.Element, reach_m: float, *, fixed: bool) -> Mass | None:
        """<inertial> of a link, in the link's frame; farther than `reach_m` from that no arm has its mass.

        A `fixed` one may be a mere frame, which some programs write with a mass of 0 or 1e-9 kg.
        """
        what = f"link {name}"
        before, inertial = len(self._problems), self._one(element, "inertial", what)
        if inertial is None or len(self._problems) > before:
            return None
        of_mass, tensor = self._one(inertial, "mass", what), self._one(inertial, "inertia", what)
        for tag, found, keys in (("mass", of_mass, ("value",)), ("inertia", tensor, ("ixx", "iyy", "izz"))):
            missing = [key for key in keys if found is None or found.get(key) is None]
            if missing:
                self._problem(f"{what}: <inertial> has no <{tag}> with {', '.join(missing)}")
        if len(self._problems) > before:
            return NO_MASS
        (mass,) = self._numbers(of_mass, "value", f"{what}: mass", (0.0,), LARGEST_MASS_kg, "grams instead of kg")
        if len(self._problems) > before:
            return NO_MASS
        if fixed and 0.0 <= mass < LEAST_MASS_kg:
            return None
        if mass < LEAST_MASS_kg:
            self._problem(f"{what}: mass (={mass:g}) must be at least {LEAST_MASS_kg:g} kg")
            return NO_MASS
        most = mass * LARGEST_LENGTH_m**2
        xx, xy, xz, yy, yz, zz = (
            float(self._numbers(tensor, key, f"{what}: {key}", (0.0,), most, "kg mm2 instead of kg m2")[0])
            for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        if len(self._problems) > before:
            return NO_MASS
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        low, middle, high = np.linalg.eigvalsh(inertia)
        if low < -_ROUNDING * high or low + middle < high * (1.0 - _ROUNDING) or not high > 0.0:
            moments = ", ".join(f"{value:.4g}" for value in (low, middle, high))
            self._problem(
                f"{what}: the principal moments of its inertia (={moments}) must be above 0, and the greatest at "
                "most the sum of the others: no body has such an inertia"
            )
            return NO_MASS
        pose = self._origin(inertial, f"{what}: inertial")
        distance, radius = float(np.linalg.norm(pose.offset_m)), math.sqrt(high / mass)
        if distance > reach_m:
            self._problem(
                f"{what}: the centre of its mass is {distance:.3g} m from its frame, must be within {reach_m:.3g} m; "
                "millimetres instead of m?"
            )
        if radius > reach_m:
            self._problem(
                f"{what}: its inertia (={high:.3g} kg m2) has its mass (={mass:g} kg) {radius:.3g} m from the centre, "
                f"must be within {reach_m:.3g} m; kg cm2 instead of kg m2, or grams?"
            )
        return of_body(mass, pose.offset_m, pose.rotation @ inertia @ pose.rotation.T)

    def _tree(
        self, links: dict[str, ElementTree.Element], joints: dict[str, UrdfJoint]
    ) -> tuple[str, dict[str, Mass | None], tuple[UrdfJoint, ...]]:
        above: dict[str, UrdfJoint] = {}
        for joint in joints.values():
            for end in (joint.parent, joint.child):
                if end not in links:
                    self._problem(f"joint {joint.name}: there is no link {end}")
            if joint.child in above:
                self._problem(
                    f"link {joint.child} has two joints above it, {above[joint.child].name} and {joint.name}: a loop; "
                    "links must form a tree"
                )
            above[joint.child] = joint
        raise_if(self._problems)
        roots = [link for link in links if link not in above]
        if not links or len(roots) != 1:
            more = f" and {len(roots) - _NAMED} more" if len(roots) > _NAMED else ""
            names = (", ".join(roots[:_NAMED]) or "none") + more
            self._problem(f"one link must have no joint above it, here: {names}; links must form a tree without loops")
        raise_if(self._problems)
        order: list[UrdfJoint] = []
        reached = [roots[0]]
        while reached:
            link = reached.pop(0)
            below = [joint for joint in joints.values() if joint.parent == link]
            order += below
            reached += [joint.child for joint in below]
        for joint in joints.values():
            if joint not in order:
                self._problem(f"joint {joint.name} is in a loop that the base {roots[0]} has no part in")
            if joint.mimics is not None and joint.mimics not in joints:
                self._problem(f"joint {joint.name}: <mimic> (={joint.mimics}) must name a joint")
            elif joint.mimics == joint.name:
                self._problem(f"joint {joint.name}: <mimic> (={joint.mimics}) must name another joint")
        reach_m = max(LEAST_REACH_m, sum(float(np.linalg.norm(joint.origin.offset_m)) for joint in order))
        masses = {
            name: self._mass(name, element, reach_m, fixed=name not in above or above[name].kind == "fixed")
            for name, element in links.items()
        }
        return roots[0], masses, tuple(order)


def _turn(axis: int, angle_rad: float) -> np.ndarray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[j, i], matrix[i, j] = s, -s
    return matrix


def _with_z_along(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is this unit vector."""
    if np.array_equal(axis, [0.0, 0.0, 1.0]):
        return np.eye(3)
    x = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [0.0, 0.0, 1.0], axis)
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(axis, x), axis))


def bodies_of(urdf: Urdf, names: tuple[str, ...], problem: Callable[[str], None]) -> list[Body]:
    """The tree of these joints, in their order; all others stand at 0.  `problem` gets a line for each."""
    index = {name: i for i, name in enumerate(names)}
    place: dict[str, tuple[int, Pose]] = {urdf.root: (-1, Pose(np.eye(3), np.zeros(3)))}
    bodies: dict[int, Body] = {}
    parts: dict[int, list[Mass]] = {i: [] for i in range(-1, len(names))}
    for joint in urdf.joints:
        parent, pose = place[joint.parent]
        mass = urdf.links[joint.child]
        if joint.name in index and joint.moves:
            i = index[joint.name]
            if parent >= i:
                problem(f"joint {names[parent]} is nearer to the base than {joint.name} and must stand before it")
            upright = _with_z_along(joint.axis)
            at = pose @ joint.origin @ Pose(upright, np.zeros(3))
            own = Pose(upright.T, np.zeros(3))
            bodies[i] = Body(parent, joint, at, own, NO_MASS)
            place[joint.child] = i, own
        else:
            place[joint.child] = parent, pose @ joint.origin
        body, own = place[joint.child]
        if mass is not None:
            parts[body].append(mass.seen_from(own))
    for i in sorted(bodies):
        if not parts[i]:
            joint = bodies[i].joint
            what = f"link {joint.child}, which joint {joint.name} moves"
            problem(f"{what}, has no <inertial>, nor has a link that is fixed to it: its mass is needed")
    return [
        Body(bodies[i].parent, bodies[i].joint, bodies[i].place, bodies[i].frame, sum(parts[i], start=NO_MASS))
        for i in sorted(bodies)
    ]
