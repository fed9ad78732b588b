"""g2o and Ceres by their Python wheels (`pip install g2o-python pyceres`) on one pose graph: `python -m bench.rivals NAME FILE`.

A process of its own, because g2o-python 0.0.12 kills its process under numpy 2. Each starts from the file's vertices, or from
odometry where there are none, and optimizes the same objective (g2o: rotation information turned into its own meaning).
Prints {"seconds", "cost", "iterations"}: CPU of the optimization alone, cost by gtsam's factors.
"""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from time import process_time
from typing import Any

import gtsam
import numpy as np

from slam_backend.core.graph import Pose, keyframe
from slam_backend.core.solvers.initialize import cost_of, initialize
from slam_backend.io.formats import read_graph
from slam_backend.io.problem import Problem, problem_of

LIMIT = 100  # iterations
GAIN = 1e-5  # relative decrease of the cost that ends it, as with gtsam


def begun(problem: Problem) -> list[Pose]:
    how = "file" if problem.graph.states is not None else "odometry"
    values = initialize(problem.factors, problem.stated, how).values
    return [problem.space.pose_in(values, keyframe(rank, 0).pose) for rank in range(len(problem.graph.ids))]


def ended(problem: Problem, poses: list[Pose]) -> float:
    values = gtsam.Values()
    for rank, pose in enumerate(poses):
        values.insert(keyframe(rank, 0).pose, pose)
    return cost_of(problem.factors, values)


def g2o(problem: Problem) -> dict[str, float]:
    import g2o as lib

    planar, name = problem.space.name == "2d", "SE2" if problem.space.name == "2d" else "SE3"

    def there(pose: Pose) -> Any:
        return lib.SE2(pose.x(), pose.y(), pose.theta()) if planar else lib.Isometry3d(pose.matrix())

    def back(found: Any) -> Pose:
        return gtsam.Pose2(*found.to_vector()) if planar else gtsam.Pose3(found.matrix())

    solver = getattr(lib, f"BlockSolver{name}")(getattr(lib, f"LinearSolverEigen{name}")())
    optimizer = lib.SparseOptimizer()
    optimizer.set_algorithm(lib.OptimizationAlgorithmLevenberg(solver))
    vertices = []
    for rank, pose in enumerate(begun(problem)):
        vertex = getattr(lib, f"Vertex{name}")()
        vertex.set_id(rank)
        vertex.set_estimate(there(pose))
        vertex.set_fixed(rank == 0)
        optimizer.add_vertex(vertex)
        vertices.append(vertex)
    edges = problem.graph.edges
    order = [0, 1, 2] if planar else [3, 4, 5, 0, 1, 2]  # translation first, and
    half = (
        np.ones(3) if planar else np.array([1.0, 1, 1, 2, 2, 2])
    )  # the quaternion's vector part: half the angle
    for n, information in enumerate(edges.information):
        edge = getattr(lib, f"Edge{name}")()
        edge.set_vertex(0, vertices[edges.i[n]])
        edge.set_vertex(1, vertices[edges.j[n]])
        edge.set_measurement(there(problem.space.pose(edges.poses[n].tolist())))
        edge.set_information(information[np.ix_(order, order)] * np.outer(half, half))
        optimizer.add_edge(edge)
    stop = lib.SparseOptimizerTerminateAction()
    stop.set_gain_threshold(GAIN)
    optimizer.add_post_iteration_action(stop)
    begin = process_time()
    optimizer.initialize_optimization()
    iterations = optimizer.optimize(LIMIT)
    seconds = process_time() - begin
    cost = ended(problem, [back(vertex.estimate()) for vertex in vertices])
    return {"seconds": seconds, "cost": cost, "iterations": iterations}


def ceres(problem: Problem) -> dict[str, float]:
    """Planar graphs only: the wheel has no pose-graph factors, so every residual is a call into Python."""
    import pyceres as lib

    class Edge(lib.CostFunction):  # type: ignore[misc, name-defined]
        def __init__(self, measured: Any, root: Any) -> None:
            super().__init__()
            self.set_num_residuals(3)
            self.set_parameter_block_sizes([3, 3])
            self._measured, self._root = measured, root

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802  # Ceres' name
            i, j = parameters
            c, s = np.cos(i[2]), np.sin(i[2])
            x, y = j[0] - i[0], j[1] - i[1]
            turn = j[2] - i[2] - self._measured[2]
            error = (
                c * x + s * y - self._measured[0],
                c * y - s * x - self._measured[1],
                turn - 2 * np.pi * np.round(turn / (2 * np.pi)),
            )
            residuals[:] = self._root @ error
            if jacobians is not None:
                at_j = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
                at_i = -at_j
                at_i[:2, 2] = c * y - s * x, -c * x - s * y
                for jacobian, block in zip(jacobians, (at_i, at_j), strict=True):
                    if jacobian is not None:
                        jacobian[:] = (self._root @ block).ravel()
            return True

    poses = [np.array([pose.x(), pose.y(), pose.theta()]) for pose in begun(problem)]
    task, edges = lib.Problem(), problem.graph.edges
    for n, information in enumerate(edges.information):
        turned = rotated(information, float(edges.states[n, 2]))
        edge = Edge(edges.states[n], np.linalg.cholesky(turned).T)
        task.add_residual_block(edge, None, [poses[edges.i[n]], poses[edges.j[n]]])
    task.set_parameter_block_constant(poses[0])
    options, summary = lib.SolverOptions(), lib.SolverSummary()
    options.linear_solver_type = lib.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    options.max_num_iterations, options.function_tolerance, options.num_threads = LIMIT, GAIN, 1
    begin = process_time()
    lib.solve(options, task, summary)
    seconds = process_time() - begin
    cost = ended(problem, [gtsam.Pose2(*pose) for pose in poses])
    return {"seconds": seconds, "cost": cost, "iterations": summary.num_successful_steps}


def rotated(information: Any, angle: float) -> Any:
    """From the axes of the measured child to those of the parent, in which `Edge` has its error."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return turn @ information @ turn.T


RIVALS: Mapping[str, Callable[[Problem], dict[str, float]]] = {"g2o": g2o, "ceres": ceres}

if __name__ == "__main__":
    print(json.dumps(RIVALS[sys.argv[1]](problem_of(read_graph(Path(sys.argv[2]))))))
