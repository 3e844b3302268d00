// What roscpp's client library can do, one part for each first argument; prints what a test then compares.
#include <ros/callback_queue.h>
#include <ros/ros.h>
#include <std_msgs/String.h>
#include <std_srvs/SetBool.h>

#include <atomic>
#include <functional>
#include <iostream>
#include <string>
#include <thread>
#include <vector>

static void say(const std::string& words) { std::cout << words << std::endl; }

static void say(const std::string& words, long number) { say(words + " " + std::to_string(number)); }

// Waits for a condition by the machine's clock; says what did not come.
static bool until(const std::string& what, const std::function<bool()>& condition) {
  for (int i = 0; i < 12000 && ros::ok(); ++i) {
    if (condition()) return true;
    ros::WallDuration(0.005).sleep();
  }
  say("never: " + what);
  return false;
}

static std_msgs::String text(const std::string& data) {
  std_msgs::String message;
  message.data = data;
  return message;
}

static bool call(ros::ServiceClient& client, bool data, std::string* answer = nullptr) {
  std_srvs::SetBool set;
  set.request.data = data;
  if (!client.call(set)) return false;
  if (answer != nullptr) *answer = set.response.message;
  return set.response.success;
}

// ---------------------------------------------------------------- parameters

static void parameters() {
  using namespace ros;
  param::set("/lib/int", 7);
  param::set("/lib/double", 2.5);
  param::set("/lib/bool", true);
  param::set("/lib/text", std::string("a <b> & \"c\" \xc3\xa9"));
  param::set("/lib/ints", std::vector<int>{1, 2, 3});
  param::set("/lib/map", std::map<std::string, double>{{"x", 1.5}, {"y", -2.0}});
  int number = 0;
  double real = 0;
  bool flag = false;
  std::string words;
  std::vector<int> ints;
  std::map<std::string, double> map;
  say("int", param::get("/lib/int", number) ? number : -1);
  say("double", param::get("/lib/double", real) ? static_cast<long>(real * 10) : -1);
  say("int as double", param::get("/lib/int", real) ? static_cast<long>(real) : -1);
  say("text as int", param::get("/lib/text", number));
  say("bool", param::get("/lib/bool", flag) && flag);
  param::get("/lib/text", words);
  say("text " + words);
  say("ints", param::get("/lib/ints", ints) ? ints.size() : -1);
  say("map", param::get("/lib/map", map) ? static_cast<long>(map["x"] * 10 + map["y"]) : -1);
  XmlRpc::XmlRpcValue tree;
  say("tree", param::get("/lib", tree) ? tree.size() : -1);
  say("has", param::has("/lib/map/x") + 2 * param::has("/lib/nothing"));
  say("default " + param::param<std::string>("/lib/nothing", "else"));
  say("search", param::search("/lib/map/deep", "int", words));
  say("found " + words);
  say("deleted", param::del("/lib/map") + 2 * param::del("/lib/map"));
  std::vector<std::string> names;
  param::getParamNames(names);
  long mine = 0;
  for (const std::string& name : names) mine += name.compare(0, 5, "/lib/") == 0;
  say("names", mine);

  say("cached first", param::getCached("/lib/cached", number) ? number : -1);
  param::set("/lib/ask", 1);
  until("a change", [&] { return param::getCached("/lib/cached", number) && number == 2; });
  say("cached changed", number);
  param::set("/lib/ask", 2);
  until("a change below", [&] { return param::getCached("/lib/tree/leaf", number) && number == 3; });
  say("cached leaf", number);
  param::set("/lib/ask", 3);
  until("a deletion", [&] { return !param::getCached("/lib/cached", number); });
  say("cached gone");
}

// ---------------------------------------------------------------- topics

static void latching(ros::NodeHandle& node) {
  ros::Publisher first = node.advertise<std_msgs::String>("cpp_latched", 10, true);
  first.publish(text("one"));
  first.publish(text("two"));
  std::string own;
  ros::Subscriber near = node.subscribe<std_msgs::String>(
      "cpp_latched", 10, [&](const std_msgs::String::ConstPtr& m) { own = m->data; });
  until("the latched message in the process", [&] { return own == "two"; });
  say("near " + own);

  std::atomic<int> heard{0};
  std::atomic<bool> latched{false};
  std::string last;
  using Event = ros::MessageEvent<std_msgs::String const>;
  const boost::function<void(const Event&)> take = [&](const Event& event) {
    last = event.getMessage()->data;
    latched = event.getConnectionHeader()["latching"] == "1";
    ++heard;
  };
  for (int i = 0; i < 5; ++i) {  // who comes again gets it again
    const int before = heard;
    ros::Subscriber late = node.subscribe<std_msgs::String>("our_latched", 10, take);
    until("our latched message", [&] { return heard > before; });
  }
  say("late " + last, heard);
  say("says so", latched);
  ros::Subscriber marks = node.subscribe<std_msgs::String>("our_latched", 10, take);
  until("a newer one", [&] { return last == "newer"; });
  say("kept " + last);
}

static void unadvertise(ros::NodeHandle& node) {
  for (int epoch = 0; epoch < 20; ++epoch) {
    ros::Publisher load = node.advertise<std_msgs::String>("load", 100);
    if (!until("a subscriber", [&] { return load.getNumSubscribers() > 0; })) return;
    const ros::WallTime end = ros::WallTime::now() + ros::WallDuration(0.02);
    while (ros::WallTime::now() < end) load.publish(text(std::to_string(epoch)));
    load.shutdown();  // while its messages wait to be sent
  }
  say("published epochs");
}

static void resubscribe(ros::NodeHandle& node) {
  for (int epoch = 0; epoch < 20; ++epoch) {
    std::atomic<int> heard{0};
    ros::Subscriber load = node.subscribe<std_msgs::String>(
        "our_load", 10, [&](const std_msgs::String::ConstPtr&) { ++heard; });
    if (!until("our load", [&] { return heard > 5; })) return;
    if (load.getNumPublishers() != 1) say("publishers", load.getNumPublishers());
    load.shutdown();
  }
  say("heard epochs");
}

// ---------------------------------------------------------------- services

static void services(ros::NodeHandle& node) {
  std::atomic<int> served{0};
  const boost::function<bool(std_srvs::SetBool::Request&, std_srvs::SetBool::Response&)> serve =
      [&](std_srvs::SetBool::Request& request, std_srvs::SetBool::Response& response) {
        ++served;
        response.success = request.data;
        response.message = "cpp";
        return static_cast<bool>(request.data);
      };
  ros::ServiceServer server = node.advertiseService("cpp_set", serve);
  say("there", ros::service::waitForService("our_set", 20000));
  std::string answer;
  ros::ServiceClient once = node.serviceClient<std_srvs::SetBool>("our_set");
  say("call", call(once, true, &answer));
  say("answer " + answer);
  say("refused", call(once, false));

  ros::ServiceClient kept = node.serviceClient<std_srvs::SetBool>("our_set", true);
  long good = 0;
  for (int i = 0; i < 200; ++i) good += call(kept, true);
  say("persistent", good);
  say("refused again", call(kept, false));
  say("still there", call(kept, true));
  std::atomic<int> many{0};
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i)
    threads.emplace_back([&] {
      ros::ServiceClient own = node.serviceClient<std_srvs::SetBool>("our_set", true);
      for (int n = 0; n < 50; ++n) many += call(own, true);
    });
  for (std::thread& thread : threads) thread.join();
  say("at once", many);

  ros::ServiceClient own = node.serviceClient<std_srvs::SetBool>("cpp_set", true);
  say("own", call(own, true));
  say("valid", kept.isValid());
  ros::ServiceClient close = node.serviceClient<std_srvs::SetBool>("our_switch");
  say("closed", call(close, false));
  say("call of a closed one", call(kept, true));
  say("valid then", kept.isValid());
  say("exists", ros::service::exists("our_set", false));
  say("opened", call(close, true));
  ros::service::waitForService("our_set", 20000);
  kept = node.serviceClient<std_srvs::SetBool>("our_set", true);
  say("call of an opened one", call(kept, true));
  ros::param::set("/lib/served", 0);
  until("the end of our calls", [] { return ros::param::has("/lib/called"); });
  say("served", served);
  server.shutdown();
  say("exists then", ros::service::exists("cpp_set", false));
  ros::param::set("/lib/served", 1);
}

// ---------------------------------------------------------------- simulated time

static void timers(ros::NodeHandle& node) {
  say("simulated", ros::Time::isSimTime());
  ros::Time::waitForValid();
  std::atomic<int> fired{0};
  std::atomic<int> once{0};
  std::atomic<bool> in_order{true};
  ros::Timer timer = node.createTimer(ros::Duration(1.0), [&](const ros::TimerEvent& event) {
    if (event.current_real < event.current_expected) in_order = false;
    ++fired;
  });
  ros::Timer single = node.createTimer(ros::Duration(0.5), [&](const ros::TimerEvent&) { ++once; }, true);
  const ros::Time begin = ros::Time::now();
  ros::Duration(10.0).sleep();
  const double slept = (ros::Time::now() - begin).toSec();
  timer.stop();
  const int count = fired;
  say("slept", slept >= 10.0 && slept < 11.0);
  say("fired", count >= 9 && count <= 11);
  say("once", once);
  say("in order", in_order);
  ros::Rate rate(2.0);
  const ros::Time start = ros::Time::now();
  for (int i = 0; i < 6; ++i) rate.sleep();
  const double took = (ros::Time::now() - start).toSec();
  say("rate", took > 2.4 && took < 4.0);
  say("stopped", fired == count);

  ros::param::set("/lib/jump", 1);
  until("a jump back", [&] { return ros::Time::now() < begin; });
  timer.start();
  until("the timer after the jump", [&] { return fired > count + 2; });
  say("fires after a jump");
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "roscpp_library");
  ros::NodeHandle node;
  ros::AsyncSpinner spinner(2);
  spinner.start();
  const std::string part = argc > 1 ? argv[1] : "";
  if (part == "parameters") parameters();
  if (part == "latching") latching(node);
  if (part == "unadvertise") unadvertise(node);
  if (part == "resubscribe") resubscribe(node);
  if (part == "services") services(node);
  if (part == "timers") timers(node);
  say("done");
  ros::shutdown();
  return 0;
}
