// The terms of the graph's cost, linearised: each adds 1/2 d^T H d + b^T d over the change d of the nodes it touches.
//
// Jacobians are analytic. Residuals are whitened (unit variance) before they are squared. Pure functions, thread-safe.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "services/fusion/chain.h"
#include "services/fusion/node_state.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

// Motion from node i to node j: equations (12) and (13) with the odometry's scale and lean,
//   p_j - p_i - exp(scale_i) R_G_W,i dp_W,
// while each of the other variables x decays towards 0 or walks: x_j - decay x_i. The lean changes as the odometry
// levels its attitude: lean_j - lean_i - lean_change. At either node the odometry takes it for 0, as well as it knows:
// j's word takes the place of i's.
struct Transition {
  Eigen::Vector3d dp_W = Eigen::Vector3d::Zero();
  Eigen::Matrix3d position_root = Eigen::Matrix3d::Identity();  // U with U^T U the inverse covariance of the first line
  StateVector decay = StateVector::Ones();                      // entries from kYaw on; 1: a random walk
  StateVector stddev = StateVector::Ones();                     // entries from kYaw on, > 0
  Eigen::Vector2d lean_change = Eigen::Vector2d::Zero();        // rad
  double lean_known = 0;                                        // 1/rad^2 per axis, by the odometry: what i's is at j,
  double lean_gained = 0;                                       // and what has come to it; negative: it doubts itself
};

// How far a position moves with the vertical that it was found under, m/rad: of (east, north, up) by (east, north).
using Lever = Eigen::Matrix<double, 3, 2>;

// Where the map says the body is if the odometry's vertical is right, equation (14): p + shared + lever tilt -
// position.
struct PositionMeasurement {
  Eigen::Vector3d p_G_B = Eigen::Vector3d::Zero();
  Eigen::Matrix3d root = Eigen::Matrix3d::Identity();  // U with U^T U the inverse covariance of what fixes do not share
  Lever lever = Lever::Zero();
};

// What the lie of the ground says of the odometry's vertical: tilt - measured.
struct TiltMeasurement {
  Eigen::Vector2d tilt = Eigen::Vector2d::Zero();      // rad, about G's east and north axes
  Eigen::Matrix2d root = Eigen::Matrix2d::Identity();  // U with U^T U the inverse covariance
};

// A true heading of the body's x axis, clockwise from north: heading + bias - measured.
struct HeadingMeasurement {
  double heading = 0.0;                                 // rad
  double stddev = 1.0;                                  // rad
  bool biased = true;                                   // by the compass's bias
  Eigen::Vector3d x_axis_W = Eigen::Vector3d::UnitX();  // the body's x axis in the odometry's world
};

// The logarithm of the odometry's scale, as a fix fitted it.
struct ScaleMeasurement {
  double log_scale = 0.0;
  double stddev = 1.0;
};

// A Gaussian about a node: what is left of the nodes before it, or a first guess. 1/2 d^T H d + b^T d in d = x - point.
struct Prior {
  StateVector point = StateVector::Zero();
  Quadratic cost;
};

// U with U^T U = covariance^-1; covariance positive definite.
Eigen::Matrix3d sqrt_information(const Eigen::Matrix3d& covariance);
Eigen::Matrix2d sqrt_information(const Eigen::Matrix2d& covariance);

// Position of the motion's end as node i predicts it, and the other variables after their decay.
NodeState predict(const Transition& transition, const NodeState& i);

// Residual of each term, for tests and for innovation checks; whitened.
StateVector residual(const Transition& transition, const NodeState& i, const NodeState& j);
Eigen::Vector3d residual(const PositionMeasurement& measurement, const NodeState& node);
Eigen::Vector2d residual(const TiltMeasurement& measurement, const NodeState& node);
double residual(const HeadingMeasurement& measurement, const NodeState& node);

// d(p + shared + lever tilt)/dx at a node.
using PositionRows = Eigen::Matrix<double, 3, kStates>;
PositionRows position_jacobian(const Lever& lever, const NodeState& node);

// d(heading + bias)/dx at a node, rad per unit; zero for an axis that stands upright and has no heading.
StateVector heading_jacobian(const HeadingMeasurement& measurement, const NodeState& node);

PairQuadratic linearise(const Transition& transition, const NodeState& i, const NodeState& j);
// `huber`: standard deviations from which the residual's norm counts linearly, equation (15).
Quadratic linearise(const PositionMeasurement& measurement, const NodeState& node, double huber);
Quadratic linearise(const TiltMeasurement& measurement, const NodeState& node, double huber);
Quadratic linearise(const HeadingMeasurement& measurement, const NodeState& node, double huber);
Quadratic linearise(const ScaleMeasurement& measurement, const NodeState& node, double huber);
Quadratic linearise(const Prior& prior, const NodeState& node);

}  // namespace orthonav::fusion
