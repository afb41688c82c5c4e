// What travels as one packet is lost as one: messages that have to arrive are cut to fit.
#pragma once

namespace orthonav {

// LCM sends a message of up to so many bytes, its channel's name and a seal (seal.h) included, as one UDP packet.
inline constexpr int kPacketBytes = 1400;

}  // namespace orthonav
