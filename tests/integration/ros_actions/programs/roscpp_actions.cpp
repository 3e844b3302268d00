// Actions of roscpp's actionlib. "servers": /simple and /full; "client": drives such servers and prints a report.
#include <actionlib/TestAction.h>
#include <actionlib/client/action_client.h>
#include <actionlib/client/simple_action_client.h>
#include <actionlib/server/action_server.h>
#include <actionlib/server/simple_action_server.h>
#include <ros/ros.h>
#include <roscpp/Empty.h>

#include <cstdlib>
#include <functional>
#include <iostream>
#include <map>
#include <mutex>
#include <sstream>
#include <string>
#include <vector>

using actionlib::TestAction;
using Simple = actionlib::SimpleActionServer<TestAction>;
using Full = actionlib::ActionServer<TestAction>;
using Client = actionlib::ActionClient<TestAction>;

static actionlib::TestResult result(int number) {
  actionlib::TestResult made;
  made.result = number;
  return made;
}

static actionlib::TestGoal goal(int number) {
  actionlib::TestGoal made;
  made.goal = number;
  return made;
}

static void execute(Simple* server, const actionlib::TestGoalConstPtr& asked) {
  actionlib::TestFeedback feedback;
  feedback.feedback = asked->goal + 1;
  server->publishFeedback(feedback);
  if (asked->goal < 0) {
    server->setAborted(result(asked->goal), "negative");
  } else if (asked->goal == 0) {
    while (!server->isPreemptRequested()) ros::Duration(0.01).sleep();
    server->setPreempted(result(-1), "as asked");
  } else {
    server->setSucceeded(result(2 * asked->goal), "doubled");
  }
}

static void serve() {
  ros::NodeHandle node;
  Simple simple(node, "simple", [&simple](const actionlib::TestGoalConstPtr& asked) { execute(&simple, asked); },
                false);
  std::map<std::string, Full::GoalHandle> handles;
  auto came = [&handles](Full::GoalHandle handle) {
    int number = handle.getGoal()->goal;
    if (number < 0) {
      handle.setRejected(result(number), "negative");
    } else if (number < 100) {
      handle.setAccepted("on it");
      handles[handle.getGoalID().id] = handle;
      if (number == 10) {
        for (auto& entry : handles) entry.second.setSucceeded(result(number), "all done");
        handles.clear();
      }
    }
  };
  auto cancelled = [&handles](Full::GoalHandle handle) {
    handles.erase(handle.getGoalID().id);
    handle.setCanceled(result(-2), "cancelled");
  };
  Full full(node, "full", came, cancelled, false);
  simple.start();
  full.start();
  ros::spin();
}

static std::string quoted(const std::string& text) { return "\"" + text + "\""; }

static void fail(const std::string& what) {
  std::cerr << what << std::endl;
  std::_Exit(1);
}

static std::string run(ros::ServiceClient& go, int number, bool cancel) {
  static actionlib::SimpleActionClient<TestAction> client("simple", true);
  if (!client.waitForServer(ros::Duration(200))) fail("no simple server");
  std::mutex lock;
  std::vector<int> heard;
  client.sendGoal(goal(number), {}, {}, [&](const actionlib::TestFeedbackConstPtr& feedback) {
    std::lock_guard<std::mutex> held(lock);
    heard.push_back(feedback->feedback);
  });
  roscpp::Empty call;
  if (!go.call(call)) fail("go");
  for (bool waits = cancel; waits; ros::Duration(0.01).sleep()) {
    std::lock_guard<std::mutex> held(lock);
    waits = heard.empty();
  }
  if (cancel) client.cancelGoal();
  if (!client.waitForResult(ros::Duration(200))) fail("no result");
  std::ostringstream text;
  std::lock_guard<std::mutex> held(lock);
  text << "[[";
  for (std::size_t n = 0; n < heard.size(); ++n) text << (n ? "," : "") << heard[n];
  text << "]," << quoted(client.getState().toString()) << "," << quoted(client.getState().getText()) << ","
       << client.getResult()->result << "]";
  return text.str();
}

static void until(const std::string& what, const std::function<bool()>& condition) {
  for (int n = 0; !condition(); ++n) {
    if (n > 2000) fail(what);
    ros::Duration(0.01).sleep();
  }
}

static std::string runMany() {
  Client client("full");
  if (!client.waitForActionServerToStart(ros::Duration(200))) fail("no full server");
  std::mutex lock;
  std::map<int, std::vector<std::string>> changes;
  std::map<int, Client::GoalHandle> goals;
  for (int number : {0, 1, 5, -1})
    goals[number] = client.sendGoal(goal(number), [&, number](Client::GoalHandle handle) {
      std::lock_guard<std::mutex> held(lock);
      changes[number].push_back(handle.getCommState().toString());
    });
  auto is = [&](int number, actionlib::CommState::StateEnum state) {
    return goals[number].getCommState() == state;
  };
  using State = actionlib::CommState;
  until("5 and -1 end", [&] { return is(5, State::DONE) && is(-1, State::DONE); });
  until("0 and 1 are active", [&] { return is(0, State::ACTIVE) && is(1, State::ACTIVE); });
  goals[0].cancel();
  until("0 ends", [&] { return is(0, State::DONE); });
  client.cancelAllGoals();
  until("1 ends", [&] { return is(1, State::DONE); });
  until("all callbacks were called", [&] {  // they come after the state
    std::lock_guard<std::mutex> held(lock);
    for (auto& entry : goals)
      if (changes[entry.first].empty() || changes[entry.first].back() != "DONE") return false;
    return true;
  });
  std::ostringstream ends, moves;
  std::lock_guard<std::mutex> held(lock);
  for (auto& entry : goals) {
    auto state = entry.second.getTerminalState();
    std::string comma = entry.first == -1 ? "" : ",", key = quoted(std::to_string(entry.first));
    ends << comma << key << ":[" << quoted(state.toString()) << "," << quoted(state.getText()) << "]";
    moves << comma << key << ":[";
    for (std::size_t n = 0; n < changes[entry.first].size(); ++n)
      moves << (n ? "," : "") << quoted(changes[entry.first][n]);
    moves << "]";
  }
  return "\"full\":{" + ends.str() + "},\"changes\":{" + moves.str() + "}";
}

int main(int argc, char** argv) {
  ros::init(argc, argv, "real", ros::init_options::NoSigintHandler);
  if (argc > 1 && std::string(argv[1]) == "servers") {
    serve();
    return 0;
  }
  ros::AsyncSpinner spinner(2);
  spinner.start();
  ros::NodeHandle node;
  ros::ServiceClient go = node.serviceClient<roscpp::Empty>("go");
  if (!go.waitForExistence(ros::Duration(200))) fail("no service go");
  std::string succeeded = run(go, 3, false), aborted = run(go, -1, false), preempted = run(go, 0, true);
  std::cout << "{\"succeeded\":" << succeeded << ",\"aborted\":" << aborted << ",\"preempted\":" << preempted << ","
            << runMany() << "}" << std::endl;
  std::_Exit(0);
}
