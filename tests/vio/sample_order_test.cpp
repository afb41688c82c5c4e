#include "services/vio/sample_order.h"

#include <gtest/gtest.h>

namespace orthonav::vio {
namespace {

struct Stamp {
  int64_t utime;
};

struct Fed {
  std::vector<int64_t> taken;
  int out_of_order = 0, in_future = 0, steps = 0;
};

Fed feed(SampleOrder<Stamp>& order, const std::vector<int64_t>& stamps) {
  Fed fed;
  for (const int64_t stamp : stamps) {
    const auto taken = order.add({stamp});
    for (const Stamp& sample : taken.samples) fed.taken.push_back(sample.utime);
    fed.out_of_order += taken.out_of_order;
    fed.in_future += taken.in_future;
    fed.steps += taken.stepped_back ? 1 : 0;
  }
  return fed;
}

using Stamps = std::vector<int64_t>;

TEST(SampleOrder, PassesWhatFollows) {
  SampleOrder<Stamp> order(100, 50);
  const Stamps stamps{-7, 10, 20, 120};
  EXPECT_EQ(feed(order, stamps).taken, stamps);
}

TEST(SampleOrder, RefusesWhatComesLateOrTwice) {
  SampleOrder<Stamp> order(100, 50);
  const Fed fed = feed(order, {0, 10, 10, 5, 20, 30});
  EXPECT_EQ(fed.taken, (Stamps{0, 10, 20, 30}));
  EXPECT_EQ(fed.out_of_order, 2);
  EXPECT_EQ(fed.in_future, 0);
}

TEST(SampleOrder, StampsInTheFutureCostNothing) {
  SampleOrder<Stamp> order(100, 50);
  const Fed fed = feed(order, {0, 10, 5000, 5010, 5020, 20, 30, 5060, 40});
  EXPECT_EQ(fed.taken, (Stamps{0, 10, 20, 30, 40}));
  EXPECT_EQ(fed.in_future, 4);
  EXPECT_EQ(fed.steps, 0);
}

TEST(SampleOrder, GoesOnAfterAGap) {
  SampleOrder<Stamp> order(100, 50);
  EXPECT_EQ(feed(order, {0, 10, 500, 520, 540}).taken, (Stamps{0, 10}));
  const Fed fed = feed(order, {560, 570});
  EXPECT_EQ(fed.taken, (Stamps{500, 520, 540, 560, 570}));
  EXPECT_EQ(fed.out_of_order + fed.in_future + fed.steps, 0);
}

TEST(SampleOrder, StepsBackWhenTheFirstStampsWereWrong) {
  SampleOrder<Stamp> order(100, 50);
  const Fed fed = feed(order, {9000, 9010, 9020, 0, 10, 20, 30, 40, 50, 60});
  EXPECT_EQ(fed.taken, (Stamps{9000, 9010, 9020, 0, 10, 20, 30, 40, 50, 60}));
  EXPECT_EQ(fed.steps, 1);
}

TEST(SampleOrder, AnotherStreamOfOldStampsDoesNotTakeOver) {
  SampleOrder<Stamp> order(100, 50);
  Stamps mixed;
  for (int64_t k = 0; k < 20; ++k) {
    mixed.push_back(10000 + 10 * k);
    mixed.push_back(10 * k);
  }
  const Fed fed = feed(order, mixed);
  EXPECT_EQ(fed.taken.size(), 20u);
  EXPECT_EQ(fed.out_of_order, 19);
  EXPECT_EQ(fed.steps, 0);
}

}  // namespace
}  // namespace orthonav::vio
